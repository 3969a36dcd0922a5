"""Lookup of the source point for each point of a level.

Rays along the level's normal, both ways, take the nearer surface that faces the same way, so that a
thin shell does not show its far side. Where they hit none within reach, the closest point counts.
"""

from typing import NamedTuple

import igl
import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from pipeline.assets.quality.measure import unit_normals
from pipeline.foreign.mesh import TriangleMesh

_BEHIND = 1e-4
"""Distance in the unit box by which rays start behind a point: float32 would miss a surface at it.
"""


class FacePoints(NamedTuple):
    """Points on a surface: their faces [N], and their barycentric coordinates there [N, 3]."""

    faces: NDArray[np.int64]
    weights: NDArray[np.float64]


class SurfaceLookup:
    """Finds points of one source, by search trees that are built once."""

    def __init__(self, mesh: TriangleMesh) -> None:
        """Build the trees of a clean, outward oriented mesh of the unit box."""
        self._mesh = mesh
        self._normals = unit_normals(mesh)
        self._tree = igl.AABB()
        self._tree.init(mesh.positions, mesh.faces)
        self._embree = EmbreeScene(robust=True)
        EmbreeMesh(self._embree, mesh.corners.astype(np.float32))

    def find(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], reach: float
    ) -> tuple[FacePoints, NDArray[np.bool_]]:
        """Return the source points that points [N, 3] with unit normals [N, 3] show.

        The second result is True [N] where no surface nearby faced the same way.

        Args:
            points: points on or near the source.
            normals: the level's normals there.
            reach: largest distance to a surface, in the unit box.
        """
        locations, is_missed = self._closest(points, normals, reach)
        best = np.full(len(points), np.inf)
        for sign in (1.0, -1.0):
            face, weights, distance = self._cast_rays(points, sign * normals)
            facing = (self._normals[face] * normals).sum(axis=1) > 0
            taken = facing & (distance <= reach) & (distance < best)
            best[taken] = distance[taken]
            locations.faces[taken] = face[taken]
            locations.weights[taken] = weights[taken]
            is_missed[taken] = False
        return locations, is_missed

    def _cast_rays(
        self, points: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return face, weights and distance of each ray's first hit; infinite without one."""
        origins = (points - _BEHIND * directions).astype(np.float32)
        hit = self._embree.run(origins, directions.astype(np.float32), output=True)
        face = np.asarray(hit["primID"], np.int64)
        u = np.asarray(hit["u"], np.float64)
        v = np.asarray(hit["v"], np.float64)
        distance = np.where(face < 0, np.inf, np.abs(np.asarray(hit["tfar"], np.float64) - _BEHIND))
        return np.maximum(face, 0), np.stack([1 - u - v, u, v], axis=1), distance

    def _closest(
        self, points: NDArray[np.float64], normals: NDArray[np.float64], reach: float
    ) -> tuple[FacePoints, NDArray[np.bool_]]:
        squared, face, nearest = self._tree.squared_distance(
            self._mesh.positions, self._mesh.faces, points
        )
        face = np.asarray(face, np.int64).ravel()
        facing = (self._normals[face] * normals).sum(axis=1) > 0
        weights = barycentric(self._mesh.corners[face], np.asarray(nearest))
        is_near = np.sqrt(np.asarray(squared).ravel()) <= reach
        return FacePoints(face, weights), ~(facing & is_near)


def barycentric(corners: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return barycentric coordinates [N, 3] of points [N, 3], clipped to triangles [N, 3, 3]."""
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    across = points - corners[:, 0]
    a, b, c = ((x * y).sum(axis=1) for x, y in ((first, first), (first, second), (second, second)))
    d = (across * first).sum(axis=1)
    e = (across * second).sum(axis=1)
    span = np.maximum(a * c - b * b, 1e-300)
    u = (c * d - b * e) / span
    v = (a * e - b * d) / span
    weights = np.clip(np.stack([1 - u - v, u, v], axis=1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)
