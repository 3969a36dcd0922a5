"""What the pixels of a camera see first: triangle, object, depth, position, normals, material.

Embree finds the triangle, in single precision and its robust mode; where on it, is then computed in
double precision from the triangle's stored corners. Emitters are hidden from cameras, so rays pass
through them. Rays go through the centres of pixels, as those of the renderer's own `hits`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.conventions import camera_rays
from storage.errors import TrilightError
from storage.records.scene import Scene

MISS = -1
"""Triangle and object of a ray that meets nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstHits:
    """The first surface along rays, [...] standing for [R, R], or for nothing of a single pixel."""

    triangle: NDArray[np.int64]
    """[...] row of `Scene.faces`, or MISS."""
    object: NDArray[np.int64]
    """[...] row of `Scene.objects`, or MISS."""
    barycentric: NDArray[np.float64]
    """[..., 3] shares of the triangle's corners, which add up to 1; NaN where nothing is met."""
    depth_m: NDArray[np.float64]
    """[...] distance along the ray; infinite where nothing is met."""
    position: NDArray[np.float64]
    """[..., 3] in world space, metres; NaN where nothing is met."""
    geometric_normal: NDArray[np.float64]
    """[..., 3] unit, in world space, towards the side from which the triangle's corners run
    counter-clockwise; NaN where nothing is met."""
    shading_normal: NDArray[np.float64]
    """[..., 3] unit, in world space, interpolated between the corners; NaN where nothing is met."""
    material: NDArray[np.float32]
    """[..., M] row of `Scene.materials` (storage.conventions); NaN where nothing is met."""

    @property
    def met(self) -> NDArray[np.bool_]:
        """[...] whether a ray meets anything."""
        met: NDArray[np.bool_] = np.asarray(self.triangle != MISS)
        return met


def first_hits(
    scene: Scene, *, view: int = 0, resolution: int = 256, pixel: tuple[int, int] | None = None
) -> FirstHits:
    """Return what a camera of a scene sees, in all pixels of its picture or in one.

    Args:
        scene: passes `Scene.check`.
        view: row of `scene.c2w`.
        resolution: width and height of the picture in pixels.
        pixel: row from the top and column from the left of the only one that is asked for.

    Raises:
        TrilightError: there is no such view or pixel.
    """
    _require("view", view, scene.num_views)
    origin, directions = camera_rays(scene.c2w[view], float(scene.fov_deg[view]), resolution)
    if pixel is not None:
        for name, value in zip(("row", "column"), pixel, strict=True):
            _require(f"pixel {name}", value, resolution)
        directions = directions[pixel]
    return _hits(scene, origin, directions)


def _require(name: str, value: int, count: int) -> None:
    if not 0 <= value < count:
        raise TrilightError(f"{name} is {value}; expected 0 to {count - 1}.")


def _hits(scene: Scene, origin: NDArray[np.float64], directions: NDArray[np.float64]) -> FirstHits:
    """Return what rays from `origin` [3] along unit `directions` [..., 3] meet first."""
    triangle = _triangles(scene, origin, directions.reshape(-1, 3)).reshape(directions.shape[:-1])
    met = triangle != MISS
    faces = scene.faces[np.where(met, triangle, 0)]
    corners = scene.vertex_positions[faces].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays that meet nothing meet triangle 0
        barycentric, depth_m = _on_triangle(corners, origin, directions)
        across = np.cross(corners[..., 1, :] - corners[..., 0, :], _edge(corners))
        normals = scene.vertex_normals[faces].astype(np.float64)
        shading = _unit(np.einsum("...c,...ci->...i", barycentric, normals))
    rows = scene.material_index[np.where(met, triangle, 0)]
    seen = met[..., None]
    return FirstHits(
        triangle=triangle,
        object=np.where(met, scene.object_index[np.where(met, triangle, 0)], MISS).astype(np.int64),
        barycentric=np.where(seen, barycentric, np.nan),
        depth_m=np.where(met, depth_m, np.inf),
        position=np.where(seen, np.einsum("...c,...ci->...i", barycentric, corners), np.nan),
        geometric_normal=np.where(seen, _unit(across), np.nan),
        shading_normal=np.where(seen, shading, np.nan),
        material=np.where(seen, scene.materials[rows], np.float32(np.nan)),
    )


def _triangles(
    scene: Scene, origin: NDArray[np.float64], directions: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the triangle [N] that each of N rays meets first, or MISS."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    solid = np.flatnonzero(~scene.triangle_emits)
    if len(solid) == 0:
        return np.full(len(directions), MISS)
    embree = EmbreeScene(robust=True)
    TriangleMesh(embree, scene.vertex_positions, scene.faces[solid])
    start = np.tile(origin.astype(np.float32), (len(directions), 1))
    found = embree.run(start, directions.astype(np.float32))
    return np.where(found >= 0, solid[found], MISS)


def _on_triangle(
    corners: NDArray[np.float64], origin: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return barycentrics [..., 3] and distances [...] at which rays meet planes of triangles.

    By Moeller and Trumbore (1997). A ray that Embree saw meeting a triangle's rim in single
    precision may pass it by a rounding; then it is brought back to the rim.
    """
    along, across = corners[..., 1, :] - corners[..., 0, :], _edge(corners)
    p = np.cross(directions, across)
    t = origin - corners[..., 0, :]
    q = np.cross(t, along)
    scale = np.sum(along * p, axis=-1)
    u, v = np.sum(t * p, axis=-1) / scale, np.sum(directions * q, axis=-1) / scale
    shares = np.clip(np.stack([1 - u - v, u, v], axis=-1), 0, 1)
    return shares / shares.sum(axis=-1, keepdims=True), np.sum(across * q, axis=-1) / scale


def _edge(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    edge: NDArray[np.float64] = corners[..., 2, :] - corners[..., 0, :]
    return edge


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.sqrt(np.sum(np.square(vectors), axis=-1, keepdims=True))
