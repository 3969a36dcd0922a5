"""The triangles of a glTF primitive in our world, with its normals, or flat ones."""

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.gltf.primitives import GltfPrimitive, is_mirrored, place_points
from storage.errors import Rejected

_SMALLEST_DOUBLE_AREA = 1e-12


class WorldTriangles:
    """The triangles of a primitive in one place that have an area."""

    def __init__(self, primitive: GltfPrimitive, to_world: NDArray[np.float64]) -> None:
        """Place them; raises Rejected where values are not finite."""
        self._primitive = primitive
        self._step = -1 if is_mirrored(to_world) else 1
        world = place_points(primitive.positions, to_world)
        corners = world[primitive.faces[:, :: self._step]]
        if not np.isfinite(corners).all():
            raise Rejected("nonfinite_vertices", "positions are not finite")
        positions = corners.astype(np.float32)
        cross = _cross(positions)
        self._kept = np.linalg.norm(cross, axis=1) > _SMALLEST_DOUBLE_AREA
        self.without_area = int((~self._kept).sum())
        self.positions = positions[self._kept]
        """[T, 3, 3]"""
        self.normals = self._normals(cross[self._kept], to_world[:3, :3])
        """[T, 3, 3] unit."""

    @property
    def colors(self) -> NDArray[np.float64] | None:
        """Linear colors [T, 3, 3] of the corners; None where there are none."""
        return self._of_corners(self._primitive.colors)

    def coordinates(self, number: int) -> NDArray[np.float64] | None:
        """Return a set of texture coordinates [T, 3, 2], v up; None where there is none.

        Raises:
            Rejected: they are not finite.
        """
        found = self._of_corners(self._primitive.coordinates(number))
        if found is not None and not np.isfinite(found).all():
            raise Rejected("texture_coordinates_not_finite", f"TEXCOORD_{number} is not finite")
        return found

    def _of_corners(self, values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        return None if values is None else values[self._kept][:, :: self._step]

    def _normals(
        self, cross: NDArray[np.float64], turn: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        flat = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        stated = self._of_corners(self._primitive.normals)
        if stated is None:
            return np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
        cofactors = np.cross(turn[[1, 2, 0]], turn[[2, 0, 1]]) * self._step
        turned = np.einsum("ij,tcj->tci", cofactors, stated)
        length = np.linalg.norm(turned, axis=2, keepdims=True)
        usable = np.isfinite(length) & (length > 0)
        unit = np.where(usable, turned / np.where(usable, length, 1), flat[:, None])
        return np.asarray(unit, np.float32)


def _cross(positions: NDArray[np.float32]) -> NDArray[np.float64]:
    wide = positions.astype(np.float64)
    return np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
