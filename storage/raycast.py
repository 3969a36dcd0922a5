"""Ray casting: which triangles rays meet, and the first hits of a camera's pixels.

Embree is the form of a `RayCaster` for numpy; a kernel of model.hits is that for tensors. A
`FirstHitCaster` is enough for passes: Embree, or Mitsuba on a GPU (pipeline.renders.kernel_scene).

A caster finds the triangle, in single precision; where on it, is then computed in double precision
from the triangle's stored corners. Emitters are hidden from cameras, so rays pass through them.
Each quantity of `FirstHits` is computed on first use.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from storage.conventions import camera_rays
from storage.errors import TrilightError
from storage.records.lookup import mapped_normals, normal_texels, textured_rows, u_directions
from storage.records.scene import Scene

MISS = -1
"""Triangle and object of a ray that meets nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RayHits:
    """First hits of N rays; arrays of the caster's kind."""

    triangle: Any
    """[N] row of the triangle, or MISS; int64."""
    uv: Any
    """[2, N] weights of its second and third corner; undefined where nothing is met; float32."""


class FirstHitCaster(Protocol):
    """Some triangles of many, as rays meet them; arrays are of one kind, all float32."""

    def intersect(self, origins: Any, directions: Any) -> RayHits:
        """Return the first hits of rays [N, 3] from `origins` [N, 3], from either side."""


class RayCaster(FirstHitCaster, Protocol):
    """A caster that also says what is free, for shadows."""

    def is_free(self, origins: Any, directions: Any, distances_m: Any) -> Any:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MetSurfaces(RayHits):
    """First hits of N rays, in Embree's precision."""

    distance_m: NDArray[np.float32]
    """[N] along the ray, in lengths of its direction; beyond all measure where nothing is met."""
    normal: NDArray[np.float32]
    """[N, 3] of the triangle's plane, in world space, of any length, towards the side from which
    its corners run counter-clockwise; undefined where nothing is met."""


class Triangles:
    """Some triangles of many, as Embree's rays meet them: a `RayCaster`.

    Embree works in single precision, here in its robust mode, in which no ray slips between two
    triangles of one edge. `pipeline.assets.cleaning.orient` calls Embree itself, without a scene.
    """

    def __init__(self, corners_T33: NDArray[np.float32], rows: NDArray[np.intp]) -> None:
        """Take the corners of triangles, world space, and the rows of those that are there."""
        count = 3 * len(rows)
        vertices = corners_T33[rows].reshape(count, 3)
        self._build(vertices, np.arange(count, dtype=np.uint32).reshape(-1, 3), rows)

    def _build(
        self, vertices: NDArray[np.float32], faces: NDArray[np.uint32], rows: NDArray[np.intp]
    ) -> None:
        """Build Embree's scene from vertices, shared by triangles or not."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._rows = np.append(rows, MISS)  # the last one, which -1 picks
        self._embree = EmbreeScene(robust=True)
        if len(rows):
            TriangleMesh(self._embree, vertices, faces)

    def intersect(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> MetSurfaces:
        """Return the first hits of rays [N, 3] from `origins` [N, 3], from either side."""
        hits = self._embree.run(origins, directions, output=True)
        return MetSurfaces(
            triangle=self._rows[hits["primID"]],
            uv=np.stack([hits["u"], hits["v"]]),
            distance_m=hits["tfar"],
            normal=hits["Ng"],
        )

    def is_free(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        distances_m: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""
        occluder = self._embree.run(origins, directions, dists=distances_m, query="OCCLUDED")
        return np.asarray(occluder) < 0


class Surfaces(Triangles):
    """The triangles of a scene that cameras see.

    Emitters are left out, since they are hidden from camera rays in the pictures too; rays pass
    through them.
    """

    def __init__(self, scene: Scene) -> None:
        rows = np.flatnonzero(~scene.triangle_emits)
        # with shared vertices, which take half the memory and time of separate corners
        self._build(scene.vertex_positions, scene.faces[rows], rows)


class SeenFrom:
    """A scene seen from one place: its surfaces, and tables of its triangles.

    Each table has T + 1 rows. The last one, which MISS picks, stands for nothing: NaN.
    """

    def __init__(
        self, scene: Scene, origin: NDArray[np.float64], surfaces: FirstHitCaster | None = None
    ) -> None:
        """Take a scene and a place; `surfaces` are its own, by default as Embree meets them."""
        self.scene = scene
        self.origin = origin
        self.surfaces = surfaces or Surfaces(scene)

    def hits(self, directions: NDArray[np.float64]) -> "FirstHits":
        """Return the first hits of rays along unit `directions` [..., 3]."""
        toward = directions.reshape(-1, 3).astype(np.float32)
        start = np.tile(self.origin.astype(np.float32), (len(toward), 1))
        triangle = self.surfaces.intersect(start, toward).triangle
        return FirstHits(
            seen=self, directions=directions, triangle=triangle.reshape(directions.shape[:-1])
        )

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """[T + 1, 3, 3] positions in meters."""
        return corner_table(self.scene, self.scene.vertex_positions)

    @cached_property
    def corner_normals(self) -> NDArray[np.float64]:
        """[T + 1, 3, 3] unit vectors."""
        return corner_table(self.scene, self.scene.vertex_normals)

    @cached_property
    def across(self) -> NDArray[np.float64]:
        """[T + 1, 3, 3] vectors whose products with a direction are as the corners' shares.

        A ray meets the triangle a, b, c, given relative to its origin, where its direction is a
        sum of a, b and c with positive weights; that of a is in proportion to its product with
        b x c (Cramer's rule).
        """
        b = np.roll(self.corners, -1, axis=1)
        c = np.roll(self.corners, -2, axis=1)
        # b x c with the difference taken first, or small triangles far away would lose digits
        return np.cross(b - self.origin, c - b)

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """[T + 1, 3] unit vectors; NaN for triangles without an area."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        with np.errstate(invalid="ignore"):
            return _unit(np.cross(b - a, c - a))

    @cached_property
    def u_directions(self) -> NDArray[np.float64]:
        """[T + 1, 3] unit directions in which u grows; 0 for triangles without any."""
        return u_directions(self.corners, self.corner_uv)

    @cached_property
    def objects(self) -> NDArray[np.int64]:
        """[T + 1] rows of `Scene.objects`; MISS for nothing."""
        return np.append(self.scene.object_index.astype(np.int64), MISS)

    @cached_property
    def materials(self) -> NDArray[np.float32]:
        """[T + 1, M] material rows."""
        rows = self.scene.materials[self.scene.material_index]
        return np.append(rows, np.full((1, rows.shape[1]), np.nan, np.float32), axis=0)

    @cached_property
    def corner_uv(self) -> NDArray[np.float64]:
        """[T + 1, 3, 2] texture coordinates; NaN throughout where the scene has none."""
        uv = np.full((self.scene.num_triangles + 1, 3, 2), np.nan)
        if self.scene.uv is not None:
            uv[:-1] = self.scene.uv.reshape(-1, 3, 2)
        return uv


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstHits:
    """The first surface along rays, [...] standing for [R, R], or for nothing of a single pixel."""

    seen: SeenFrom
    """The scene and the rays' origin."""
    directions: NDArray[np.float64]
    """[..., 3] unit vectors in world space."""
    triangle: NDArray[np.int64]
    """[...] row of `Scene.faces`, or MISS."""

    @property
    def met(self) -> NDArray[np.bool_]:
        """[...] True for rays that meet a surface."""
        is_met: NDArray[np.bool_] = np.asarray(self.triangle != MISS)
        return is_met

    @property
    def object(self) -> NDArray[np.int64]:
        """[...] row of `Scene.objects`, or MISS."""
        return self.seen.objects[self.triangle]

    @cached_property
    def barycentric(self) -> NDArray[np.float64]:
        """[..., 3] shares of the triangle's corners, which add up to 1; NaN where nothing is met.

        A ray that Embree saw meeting a triangle's rim in single precision may pass it by a
        rounding; then it is brought back to the rim. For a ray in the very plane of a triangle,
        its middle stands.
        """
        weights = np.einsum("...ci,...i->...c", self.seen.across[self.triangle], self.directions)
        total = weights.sum(axis=-1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.clip(np.where(total == 0, 1 / 3, weights / total), 0, 1)
        return shares / shares.sum(axis=-1, keepdims=True)

    @cached_property
    def position(self) -> NDArray[np.float64]:
        """[..., 3] in world space, meters; NaN where nothing is met."""
        return self.interpolate(self.seen.corners)

    @cached_property
    def depth_m(self) -> NDArray[np.float64]:
        """[...] distance along the ray; infinite where nothing is met."""
        along = np.einsum("...i,...i->...", self.position - self.seen.origin, self.directions)
        return np.where(self.met, along, np.inf)

    @cached_property
    def geometric_normal(self) -> NDArray[np.float64]:
        """[..., 3] unit normal of the triangle's plane, in world space.

        It points to the side from which the corners run counter-clockwise; NaN where nothing is
        met.
        """
        return self.seen.normals[self.triangle]

    @cached_property
    def shading_normal(self) -> NDArray[np.float64]:
        """[..., 3] unit, in world space, interpolated between the corners, bent by a normal map.

        It is not turned to the camera. NaN where nothing is met, or where the corners' normals
        cancel out.
        """
        with np.errstate(invalid="ignore"):
            normals = _unit(self.interpolate(self.seen.corner_normals))
        scene = self.seen.scene
        if scene.normal_textures is not None:
            is_met = self.met
            triangle = self.triangle[is_met]
            texels = normal_texels(scene, scene.material_index[triangle], self.uv[is_met])
            u_direction = self.seen.u_directions[triangle]
            normals[is_met] = mapped_normals(normals[is_met], u_direction, texels)
        return normals

    @cached_property
    def uv(self) -> NDArray[np.float64]:
        """[..., 2] texture coordinates; NaN where nothing is met or the scene has none."""
        return self.interpolate(self.seen.corner_uv)

    @cached_property
    def material(self) -> NDArray[np.float32]:
        """[..., M] row of `Scene.materials`, with its textures; NaN where nothing is met."""
        rows = self.seen.materials[self.triangle]
        scene = self.seen.scene
        if scene.textures:
            is_met = self.met
            index = scene.material_index[self.triangle[is_met]]
            rows[is_met] = textured_rows(scene, index, self.uv[is_met])
        return rows

    def interpolate(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return [..., K] between the corners of a table [T + 1, 3, K]."""
        return np.einsum("...c,...ci->...i", self.barycentric, corners[self.triangle])


def first_hits(
    scene: Scene, *, view: int = 0, resolution: int = 256, pixel: tuple[int, int] | None = None
) -> FirstHits:
    """Return the first hits of a camera of a scene, in all pixels of its picture or in one.

    Rays go through the centers of pixels, as those of the renderer's own `hits`. The scene passes
    `Scene.check`; `view` is a row of `scene.c2w`, and `pixel` the row from the top and the column
    from the left. It raises TrilightError where there is no such view or pixel.
    """
    require_row("view", view, scene.num_views)
    origin, directions = camera_rays(scene.c2w[view], float(scene.fov_deg[view]), resolution)
    if pixel is not None:
        for name, value in zip(("row", "column"), pixel, strict=True):
            require_row(f"pixel {name}", value, resolution)
        directions = directions[pixel]
    return SeenFrom(scene, origin).hits(directions)


def require_row(name: str, value: int, count: int) -> None:
    """Raise TrilightError unless `value` is one of `count` rows."""
    if not 0 <= value < count:
        raise TrilightError(f"{name} is {value}; expected 0 to {count - 1}.")


def corner_table(scene: Scene, of_vertices: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the rows of vertices [V, 3] at the corners of triangles, [T + 1, 3, 3], last NaN."""
    corners = of_vertices[scene.faces].astype(np.float64)
    return np.append(corners, np.full((1, 3, 3), np.nan), axis=0)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.sqrt(np.sum(np.square(vectors), axis=-1, keepdims=True))
