"""`LitScene`: the triangles of a scene as rays need them, with their lobes and their emission."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.hits.textures import SurfaceTextures
from model.hits.vectors import Floats, as_rows, brightest, dot, unit
from model.sky.sampler import SkySampler
from storage.records.environment import Environment
from storage.records.lobes import lobes_of
from storage.records.material import EMISSION, ROUGHNESS
from storage.records.multiscatter import scattered_again
from storage.records.surfaces import MetSurfaces, Triangles

_OFFSET = np.float32(1500 * 2.0**-24)
"""How far rays start off a surface, as a share of 1 m plus their distance from the origin: the
renderer's own (pipeline.renders.kernel_scene)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Reflecting:
    """How each of N triangles or points reflects; all float32."""

    diffuse: Floats
    """[3, N] diffuse albedo."""
    specular: Floats
    """[3, N] specular albedo."""
    alpha: Floats
    """[N] GGX width."""
    again: Floats
    """[3, N] Fms of storage.records.multiscatter."""
    roughness: Floats
    """[N] roughness."""

    def only(self, rows: NDArray[np.intp]) -> "Reflecting":
        """Return some of them."""
        return Reflecting(**{name: each[..., rows] for name, each in vars(self).items()})


def reflecting(materials: NDArray[np.float32]) -> Reflecting:
    """Return how material rows [N, 10] reflect."""
    lobes = lobes_of(materials)
    again = scattered_again(lobes.specular, lobes.alpha, "correlated")
    return Reflecting(
        diffuse=lobes.diffuse.T.astype(np.float32),
        specular=lobes.specular.T.astype(np.float32),
        alpha=lobes.alpha.astype(np.float32),
        again=again.T.astype(np.float32),
        roughness=materials[:, ROUGHNESS].reshape(-1).astype(np.float32),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """P points of surfaces, each seen from one side; all float32."""

    triangle: NDArray[np.intp]
    """[P] row of the scene."""
    position: Floats
    """[3, P] metres, world space."""
    normal: Floats
    """[3, P] unit shading normal, turned with the triangle to the side from which it is seen."""
    plane: Floats
    """[3, P] unit normal of the triangle, on the side of the shading normal."""
    toward: Floats
    """[3, P] unit vector to where the point is seen from."""
    edge: Floats
    """[3, P] an edge of the triangle: what frames are built on, so that they turn with the world.
    """
    back: NDArray[np.bool_]
    """[P] whether the triangle is seen from the side from which its corners run clockwise."""
    reflecting: Reflecting | None = None
    """How the points reflect, in textured scenes; None: as their triangles do in the mean."""

    def only(self, rows: NDArray[np.intp]) -> "Points":
        """Return some of the points."""
        return Points(
            triangle=self.triangle[rows],
            position=self.position[:, rows],
            normal=self.normal[:, rows],
            plane=self.plane[:, rows],
            toward=self.toward[:, rows],
            edge=self.edge[:, rows],
            back=self.back[rows],
            reflecting=None if self.reflecting is None else self.reflecting.only(rows),
        )

    def start(self, direction: Floats) -> Floats:
        """Return where rays [3, P] that leave the surface begin."""
        return off_surface(self.position, self.plane, direction)


def off_surface(position: Floats, plane: Floats, direction: Floats) -> Floats:
    """Return where rays [3, P] along `direction` begin, off the surface on their side."""
    off = (1 + brightest(np.abs(position))) * _OFFSET
    start: Floats = plane * np.copysign(off, dot(plane, direction))
    start += position
    return start


class LitScene:
    """Tables of T triangles, components first: [3, T] and [T]."""

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
            corners_T33: positions in metres.
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
        means = reflecting(materials_TM)
        self.diffuse, self.specular, self.again = means.diffuse, means.specular, means.again
        self.alpha, self.roughness = means.alpha, means.roughness
        self.textures, self._materials_TM = textures, materials_TM
        self.sky = sky
        self.emission = np.ascontiguousarray(materials_TM[:, EMISSION].T.astype(np.float32))
        self._corner_rows = corners_T33
        self.emits = self.emission.max(axis=0) > 0
        self.lamps: NDArray[np.intp] = np.flatnonzero(self.emits & (self.area > 0))

    @property
    def num_triangles(self) -> int:
        return len(self.area)

    @cached_property
    def drawn_sky(self) -> SkySampler:
        """The sky of a scene that has one, for rays."""
        assert self.sky is not None
        return SkySampler(self.sky)

    @cached_property
    def seen(self) -> Triangles:
        """What cameras see: all but emitters, which are hidden from them."""
        return Triangles(self._corner_rows, np.flatnonzero(~self.emits))

    @cached_property
    def everything(self) -> Triangles:
        """What blocks light and reflects it."""
        return Triangles(self._corner_rows, np.arange(self.num_triangles))

    def diffuse_at(self, points: Points) -> Floats:
        """Return the diffuse albedo [3, P]."""
        if points.reflecting is not None:
            return points.reflecting.diffuse
        return np.take(self.diffuse, points.triangle, axis=1)

    def specular_at(self, points: Points) -> Floats:
        """Return the specular albedo [3, P]."""
        if points.reflecting is not None:
            return points.reflecting.specular
        return np.take(self.specular, points.triangle, axis=1)

    def again_at(self, points: Points) -> Floats:
        """Return Fms of multiple scattering [3, P]."""
        if points.reflecting is not None:
            return points.reflecting.again
        return np.take(self.again, points.triangle, axis=1)

    def alpha_at(self, points: Points) -> Floats:
        """Return the GGX width [P]."""
        if points.reflecting is not None:
            return points.reflecting.alpha
        return self.alpha[points.triangle]

    def roughness_at(self, points: Points) -> Floats:
        """Return the roughness [P]."""
        if points.reflecting is not None:
            return points.reflecting.roughness
        return self.roughness[points.triangle]

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
        plane = self.plane[:, triangle]
        back = dot(plane, direction) > 0
        # as the renderer: the triangle's own normal goes with the shading normal, then both turn
        plane = plane * np.where(dot(plane, normal) < 0, np.float32(-1), np.float32(1))
        turn = np.where(dot(plane, direction) > 0, np.float32(-1), np.float32(1))
        return Points(
            triangle=triangle,
            position=position,
            normal=normal * turn,
            plane=plane * turn,
            toward=-direction,
            edge=np.take(self.edge, triangle, axis=1),
            back=back,
            reflecting=self._textured(triangle, weights),
        )

    def _textured(self, triangle: NDArray[np.intp], weights: Floats) -> Reflecting | None:
        if self.textures is None:
            return None
        return reflecting(self.textures.materials(triangle, weights, self._materials_TM))

    def first_hits(self, origin: Floats, direction: Floats) -> MetSurfaces:
        """Return what rays [3, P] from one camera [3] see first."""
        start = np.broadcast_to(origin, (direction.shape[1], 3))
        return self.seen.met(np.ascontiguousarray(start), as_rows(direction))

    def first_points(self, origin: Floats, direction: Floats) -> tuple[Points, NDArray[np.intp]]:
        """Return what rays [3, P] from one camera [3] see first, and which of them see anything."""
        found = self.first_hits(origin, direction)
        rows = np.flatnonzero(found.triangle >= 0)
        return self.points(found.triangle[rows], found.uv[:, rows], direction[:, rows]), rows

    def meet(self, among: Triangles, start: Floats, direction: Floats) -> tuple[Points, NDArray]:
        """Return the points that rays [3, P] meet first among triangles, and which rays do.

        Of a ray that meets nothing, the point is one of the first triangle and means nothing.
        """
        found = among.met(as_rows(start), as_rows(direction))
        met = found.triangle >= 0
        return self.points(np.maximum(found.triangle, 0), found.uv, direction), met


def _between(corners: Floats, triangle: NDArray[np.intp], weights: Floats) -> Floats:
    """Return [3, P] between the corners [corner, 3, T] of triangles."""
    result: Floats = np.take(corners[0], triangle, axis=1) * weights[0]
    result += np.take(corners[1], triangle, axis=1) * weights[1]
    result += np.take(corners[2], triangle, axis=1) * weights[2]
    return result
