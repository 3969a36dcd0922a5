"""`LitScene`: a scene as rays need it: triangles, their emission, its sky, and lobes at points.

The specular lobe is GGX without Fresnel, compensated for multiple scattering: the arithmetic of
pipeline.renders.ggx in numpy; tests hold the two beside each other.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray

from model.hits.device_arrays import DeviceArray, DevicePlace
from model.hits.device_rays import DeviceTriangles, compiled_kernel
from model.hits.textures import DeviceTextures, SurfaceTextures
from model.hits.vectors import Floats, as_rows, at_rows, brightest, dot, tangents, unit
from storage.conventions import latlong_uv
from storage.optics import ROUGHNESS_STEPS, X_STEPS, albedo_table, bsdf_lobes, scattered_again
from storage.raycast import RayCaster, RayHits, Triangles
from storage.records.lookup import environment_values
from storage.records.material import EMISSION, ROUGHNESS
from storage.records.texture import Environment, row_solid_angles, texel_means

if TYPE_CHECKING:
    from model.hits.radiosity import SceneLight

MOST_LAMPS = 2**11
"""Emitting triangles with which a scene's rays are traced by a GPU: their random numbers take 1 GB
at 256 pixels, and 4 GB at 512."""

_OFFSET = np.float32(1500 * 2.0**-24)
"""Distance from a surface at which rays start, as a fraction of 1 m plus their distance from the
origin: as in the renderer (pipeline.renders.kernel_scene)."""


_INV_PI = np.float32(1 / np.pi)
_LEAST_COSINE = np.float32(1e-4)

MaterialName = Literal["diffuse", "specular", "alpha", "multiscatter", "roughness"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PerPoint:
    """Arrays [..., P] of P points, triangles or pixels, or None."""

    def only(self, rows: Any, *, but: str = "") -> Self:
        """Return some of them; of None, all with an axis before that of points.

        `but` names a field that stays as it is.
        """
        some = {
            name: each.only(rows)
            if isinstance(each, PerPoint)
            else each[..., None, :]
            if rows is None
            else at_rows(each, rows)
            for name, each in vars(self).items()
            if each is not None and name != but
        }
        return replace(self, **some)


@dataclass(frozen=True, kw_only=True, eq=False)
class Reflectance(PerPoint):
    """Reflectance of N triangles or points; all float32."""

    diffuse: Floats
    """[3, N] diffuse albedo, linear, 0 to 1."""
    specular: Floats
    """[3, N] specular albedo, linear, 0 to 1."""
    alpha: Floats
    """[N] GGX width, above 0 and at most 1."""
    multiscatter: Floats
    """[3, N] Fms of storage.optics."""
    roughness: Floats
    """[N] roughness of the material, 0 to 1."""


def reflectance_of(materials: NDArray[np.float32]) -> Reflectance:
    """Return the reflectance of material rows [N, 10]."""
    lobes = bsdf_lobes(materials)
    multiscatter = scattered_again(lobes.specular, lobes.alpha, "correlated")
    return Reflectance(
        diffuse=lobes.diffuse.T.astype(np.float32),
        specular=lobes.specular.T.astype(np.float32),
        alpha=lobes.alpha.astype(np.float32),
        multiscatter=multiscatter.T.astype(np.float32),
        roughness=materials[:, ROUGHNESS].reshape(-1).astype(np.float32),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Points(PerPoint):
    """P points of surfaces, each seen from one side; all float32."""

    triangle: NDArray[np.intp]
    """[P] row of the scene."""
    position: Floats
    """[3, P] meters, world space."""
    normal: Floats
    """[3, P] unit shading normal, turned with the triangle to the side from which it is seen."""
    geometric_normal: Floats
    """[3, P] unit normal of the triangle, on the side of the shading normal."""
    to_viewer: Floats
    """[3, P] unit vector from the point to its viewer."""
    edge: Floats
    """[3, P] an edge of the triangle: what frames are built on, so that they turn with the world.
    """
    back: NDArray[np.bool_]
    """[P] True: the viewer is on the side from which the triangle's corners run clockwise."""
    reflectance: Reflectance | None = None
    """Reflectance of the points in textured scenes; None: the mean one of their triangles."""

    def start(self, direction: Floats) -> Floats:
        """Return the starts of rays [3, P] that leave the surface."""
        return off_surface(self.position, self.geometric_normal, direction)


def off_surface(position: Floats, plane: Floats, direction: Floats) -> Floats:
    """Return the starts of rays [3, P] along `direction`, off the surface on their side."""
    off = (1 + brightest(np.abs(position))) * _OFFSET
    start: Floats = plane * np.copysign(off, dot(plane, direction))
    start += position
    return start


_BLURRED_ROWS = 16
"""Number of rows of the blurred map: 11 degrees each."""


class SkySampler:
    """Importance sampling of an environment map that is not all black.

    A texel is sampled in proportion to its flux, and a direction within it uniformly by solid
    angle, so that most samples hit a sun of one texel. Samples are drawn in the axes of the map, so
    that a scene rotated together with its map has the same noise.
    """

    def __init__(self, sky: Environment) -> None:
        # in double precision, in which rays are turned to the map
        self.sky = replace(sky, rotation=sky.rotation.astype(np.float64))
        height, width = sky.radiance_rgb.shape[:2]
        angles = row_solid_angles(height)[:, None]
        flux = texel_means(sky.radiance_rgb.mean(axis=-1, dtype=np.float64)) * angles
        self._probability = flux.ravel() / flux.sum()
        self._cumulative = np.cumsum(self._probability)
        self._pdf = flux / flux.sum() / angles
        self._edges = np.cos(np.pi * np.arange(height + 1) / height)
        self._height = height
        self._width = width

    def sample_directions(self, u: Floats) -> Floats:
        """Return unit world directions [3, P] for numbers u [2, P] in the unit square."""
        first = u[0].astype(np.float64)
        texel = np.searchsorted(self._cumulative, first, side="right").clip(
            0, len(self._probability) - 1
        )
        share = self._probability[texel]
        along = (first - (self._cumulative[texel] - share)) / np.maximum(share, 1e-300)
        row = texel // self._width
        column = texel % self._width
        z = self._edges[row] + (self._edges[row + 1] - self._edges[row]) * u[1]
        azimuth = (0.5 - (column + along.clip(0, 1)) / self._width) * 2 * np.pi
        flat = np.sqrt(np.maximum(1 - z * z, 0))
        local = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z])
        return (self.sky.rotation @ local).astype(np.float32)

    def pdf(self, direction: Floats) -> Floats:
        """Return the probability density [P] of unit directions [3, P], per steradian."""
        u, v = np.moveaxis(latlong_uv(self.sky.to_map(direction.T)), -1, 0)
        row = ((1 - v) * self._height).astype(np.intp).clip(0, self._height - 1)
        column = np.floor(u * self._width).astype(np.intp) % self._width
        return self._pdf[row, column].astype(np.float32)

    def radiance(self, direction: Floats) -> Floats:
        """Return the radiance [3, P] from unit directions [3, P]."""
        return environment_values(self.sky, as_rows(direction)).T.astype(np.float32)

    def blurred_radiance(self, direction: Floats) -> Floats:
        """Return the radiance [3, P] of a blurred map with few rows and the same total flux."""
        return environment_values(self._coarse, as_rows(direction)).T.astype(np.float32)

    @cached_property
    def _coarse(self) -> Environment:
        factor = max(self._height // _BLURRED_ROWS, 1)
        while self._height % factor:
            factor -= 1
        rows = self._height // factor
        angles: NDArray[np.float64] = row_solid_angles(self._height)[:, None, None]
        light = (self.sky.radiance_rgb * angles).reshape(rows, factor, 2 * rows, factor, 3)
        means = (
            light.sum(axis=(1, 3))
            / (factor**2 * angles.reshape(rows, factor).mean(axis=1))[:, None, None]
        )
        return Environment(radiance_rgb=means.astype(np.float32), rotation=self.sky.rotation)


class LitScene:
    """Tables of T triangles, components first: [3, T] and [T]."""

    place: DevicePlace | None = None
    """Device that holds its tables, as `DeviceArray`s; None: the CPU."""

    def __init__(
        self,
        corners_T33: Floats,
        normals_T33: Floats,
        materials_TM: NDArray[np.float32],
        textures: SurfaceTextures | None = None,
        sky: Environment | None = None,
    ) -> None:
        """Take triangles in world space.

        Args:
            corners_T33: positions in meters.
            normals_T33: unit shading normals at the corners.
            materials_TM: the ten published numbers of each triangle's material, emission linear;
                of textures, their means.
            textures: what stands for those numbers at each point; None where nothing is textured.
            sky: light from far away; None where there is none, or no ray is to look for it.
        """
        self.corners = np.ascontiguousarray(corners_T33.transpose(1, 2, 0))  # [corner, 3, T]
        self.normals = np.ascontiguousarray(normals_T33.transpose(1, 2, 0))
        edges = self.corners[1:] - self.corners[0]
        self.edge = np.ascontiguousarray(edges[0])
        across = np.cross(edges[0], edges[1], axis=0)
        self.area = 0.5 * np.sqrt(dot(across, across))
        self.plane = unit(across)
        self.means = reflectance_of(materials_TM)
        self.textures: Any = textures  # on a GPU `DeviceTextures`
        self._materials_TM = materials_TM
        self.sky = sky
        self.emission = np.ascontiguousarray(materials_TM[:, EMISSION].T.astype(np.float32))
        self._corner_rows = corners_T33
        self.emits = self.emission.max(axis=0) > 0
        self.lamps: NDArray[np.intp] = np.flatnonzero(self.emits & (self.area > 0))

    @property
    def num_triangles(self) -> int:
        return len(self.area)

    @property
    def device(self) -> torch.device | None:
        """The GPU where its rays are traced; None: the CPU."""
        return None if self.place is None else self.place.device

    def on_device(self, device: torch.device) -> "LitScene":
        """Return the scene on a GPU that traces its rays; itself where none does.

        Scenes with thousands of lamps stay with the CPU.
        """
        if len(self.lamps) > MOST_LAMPS or compiled_kernel(device) is None:
            return self
        return self.on(DevicePlace(device), DeviceTriangles)

    def on(self, place: DevicePlace, caster: Callable[..., RayCaster]) -> "LitScene":
        """Return the scene and its light on a device, where `caster` prepares its rays."""
        moved = place.copy_here(self, but=("lamps", "sky", "textures", "light", "_corner_rows"))
        moved.place = place
        moved.light = place.copy_here(self.light)
        if self.textures is not None:
            moved.textures = DeviceTextures(self.textures, place)
        if self.sky is not None:
            moved.drawn_sky = place.copy_here(self.drawn_sky)
        moved.seen = caster(self._corner_rows, np.flatnonzero(~self.emits), place)
        moved.everything = caster(self._corner_rows, np.arange(self.num_triangles), place)
        scene: LitScene = moved
        return scene

    def here(self, array: NDArray) -> Any:
        """Return an array of the host where the scene's tables are."""
        if self.place is None:
            return array
        return DeviceArray(self.place.tensor(array), self.place)

    @cached_property
    def light(self) -> "SceneLight":
        """Light that the triangles receive."""
        from model.hits.radiosity import scene_light  # it traces rays in scenes

        return scene_light(self)

    @cached_property
    def drawn_sky(self) -> SkySampler:
        """The sky of a scene that has one, for rays."""
        assert self.sky is not None
        return SkySampler(self.sky)

    @cached_property
    def seen(self) -> RayCaster:
        """The triangles that cameras see: all but emitters, which are hidden from them."""
        return Triangles(self._corner_rows, np.flatnonzero(~self.emits))

    @cached_property
    def everything(self) -> RayCaster:
        """All triangles, which block and reflect light."""
        return Triangles(self._corner_rows, np.arange(self.num_triangles))

    def material_at(self, points: Points, name: MaterialName) -> Floats:
        """Return an entry of `Reflectance` at points: [3, P], or [P] of alpha and roughness."""
        if points.reflectance is None:
            return np.take(getattr(self.means, name), points.triangle, axis=-1)
        at_points: Floats = getattr(points.reflectance, name)
        return at_points

    def points(self, triangle: NDArray[np.intp], uv: Floats, direction: Floats) -> Points:
        """Return the points at which rays along unit `direction` [3, P] meet triangles.

        Args:
            triangle: [P] rows.
            uv: [2, P] weights of the second and third corner.
            direction: [3, P] of the rays.
        """
        weights = np.stack([1 - uv[0] - uv[1], uv[0], uv[1]])
        position = _between(self.corners, triangle, weights)
        normal = unit(_between(self.normals, triangle, weights))
        plane = at_rows(self.plane, triangle)
        back = dot(plane, direction) > 0
        # as the renderer: the triangle's own normal goes with the shading normal, then both turn
        plane = plane * np.where(dot(plane, normal) < 0, np.float32(-1), np.float32(1))
        flip = np.where(dot(plane, direction) > 0, np.float32(-1), np.float32(1))
        reflectance = None
        if self.textures is not None:
            materials = self.textures.materials(triangle, weights, self._materials_TM)
            reflectance = reflectance_of(materials)
        return Points(
            triangle=triangle,
            position=position,
            normal=normal * flip,
            geometric_normal=plane * flip,
            to_viewer=-direction,
            edge=np.take(self.edge, triangle, axis=1),
            back=back,
            reflectance=reflectance,
        )

    def first_hits(self, origin: Floats, direction: Floats) -> RayHits:
        """Return the first hits of rays [3, P] from one camera [3]."""
        start = np.broadcast_to(origin, (direction.shape[1], 3))
        return self.seen.intersect(start.copy(), as_rows(direction))

    def meet(self, start: Floats, direction: Floats) -> tuple[Points, NDArray]:
        """Return the points that rays [3, P] meet first, and which rays meet any.

        Of a ray that meets nothing, the point is one of the first triangle and means nothing.
        """
        hits = self.everything.intersect(as_rows(start), as_rows(direction))
        is_hit = hits.triangle >= 0
        return self.points(np.maximum(hits.triangle, 0), hits.uv, direction), is_hit


def _between(corners: Floats, triangle: NDArray[np.intp], weights: Floats) -> Floats:
    """Return [3, P] between the corners [corner, 3, T] of triangles."""
    result: Floats = np.take(corners[0], triangle, axis=1) * weights[0]
    result += np.take(corners[1], triangle, axis=1) * weights[1]
    result += np.take(corners[2], triangle, axis=1) * weights[2]
    return result


@dataclass(frozen=True, kw_only=True, eq=False)
class Gloss(PerPoint):
    """The specular lobes of P points, each as its viewer sees it."""

    color: Floats
    """[3, P] specular albedo times the scale that multiple scattering brings."""
    alpha: Floats
    """[P] GGX width, above 0 and at most 1."""
    cos_seen: Floats
    """[P] cosine between shading normal and viewer."""
    stretch_seen: Floats
    """[P] length of the viewer's direction on stretched facets."""
    faces: NDArray[np.bool_]
    """[P] True: the viewer is above the shading normal's horizon; below there is no lobe."""


def gloss_at(scene: LitScene, points: Points, least_alpha: Floats | None = None) -> Gloss:
    """Return the lobes of points, those that are narrower than `least_alpha` [P] widened to it."""
    alpha = scene.material_at(points, "alpha")
    if least_alpha is not None:
        alpha = np.maximum(alpha, least_alpha)
    cosine = dot(points.normal, points.to_viewer)
    seen = np.maximum(cosine, _LEAST_COSINE)
    stretch = stretched_length(seen, alpha)
    albedo = np.maximum(_albedo(scene, seen / stretch, alpha), np.float32(1e-3))
    lost = (1 - albedo) / albedo
    specular = scene.material_at(points, "specular")
    multiscatter = scene.material_at(points, "multiscatter")
    return Gloss(
        color=specular * (1 + multiscatter * lost),
        alpha=alpha,
        cos_seen=seen,
        stretch_seen=stretch,
        faces=cosine > _LEAST_COSINE,
    )


def stretched_length(cosine: Floats, alpha: Floats) -> Floats:
    """Return the length of (alpha sin, cos)."""
    square = cosine * cosine
    length: Floats = np.sqrt(square + alpha * alpha * (1 - square))
    return length


def lobe(
    gloss: Gloss, points: Points, to_light: Floats, cos_light: Floats
) -> tuple[Floats, Floats]:
    """Return D G2 / (4 cos_i cos_o) cos_o without color, and `sample_lobe`'s density, [P] each.

    Args:
        to_light: [3, P] unit vectors.
        cos_light: [P] their cosine with the shading normal; where it is not above 0 the lobe is 0.
    """
    half = unit(to_light + points.to_viewer)
    upright = dot(half, points.normal)
    squared = gloss.alpha * gloss.alpha
    # sin^2 + alpha^2 cos^2, with sin^2 from the part across: 1 - cos^2 cancels for a small alpha
    across = half - points.normal * upright
    denominator = dot(across, across) + squared * upright * upright
    distribution = _INV_PI * squared / np.maximum(denominator * denominator, np.float32(1e-30))
    above = np.maximum(cos_light, _LEAST_COSINE)
    masked = gloss.stretch_seen / gloss.cos_seen + stretched_length(above, gloss.alpha) / above
    value = distribution / (2 * gloss.cos_seen * masked)
    density = distribution / (2 * (gloss.cos_seen + gloss.stretch_seen))
    shines = gloss.faces & (cos_light > 0) & (dot(to_light, points.geometric_normal) > 0)
    return np.where(shines, value, np.float32(0)), density


def sample_lobe(gloss: Gloss, points: Points, u: Floats) -> tuple[Floats, Floats]:
    """Return directions [3, P] drawn by visible normals from u [2, P], and their weights [P].

    A weight is what the lobe sends along the direction, cosine included, over the density: G2 / G1.
    Spherical caps (Dupuy and Benyoub 2023).
    """
    first, second = tangents(points.normal, points.edge)
    seen = np.stack([dot(points.to_viewer, first), dot(points.to_viewer, second), gloss.cos_seen])
    wide = np.stack([gloss.alpha, gloss.alpha, np.ones_like(gloss.alpha)])
    bent = unit(seen * wide)
    height = 1 - u[1] * (1 + bent[2])
    radius = np.sqrt(np.maximum(1 - height * height, 0))
    angle = np.float32(2 * np.pi) * u[0]
    cap = np.stack([radius * np.cos(angle), radius * np.sin(angle), height]) + bent
    half = unit(cap * wide)
    local = half * (2 * dot(seen, half)) - seen
    cosine = local[2]
    above = np.maximum(cosine, _LEAST_COSINE)
    masked_seen = gloss.stretch_seen / gloss.cos_seen
    masked = stretched_length(above, gloss.alpha) / above
    direction = first * local[0] + second * local[1] + points.normal * local[2]
    goes = gloss.faces & (cosine > 0) & (dot(direction, points.geometric_normal) > 0)
    weight = (1 + masked_seen) / (masked_seen + masked)
    return direction, np.where(goes, weight, np.float32(0))


def _albedo(scene: LitScene, stretched_cosine: Floats, alpha: Floats) -> Floats:
    """Return the directional albedo [P] between the entries of the table."""
    table = scene.here(_table())
    u = np.sqrt(stretched_cosine) * np.float32(X_STEPS - 1)
    v = np.sqrt(alpha) * np.float32(ROUGHNESS_STEPS - 1)
    column = np.minimum(u.astype(np.int32), X_STEPS - 2)
    row = np.minimum(v.astype(np.int32), ROUGHNESS_STEPS - 2)
    u = u - column
    v = v - row
    at = row * X_STEPS + column
    low = table[at] * (1 - u) + table[at + 1] * u
    high = table[at + X_STEPS] * (1 - u) + table[at + X_STEPS + 1] * u
    between: Floats = low * (1 - v) + high * v
    return between


@cache
def _table() -> Floats:
    return albedo_table("correlated").astype(np.float32).ravel()
