"""Triangles of a glTF primitive in world space, without those of zero area."""

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.textured_triangles import have_areas
from pipeline.foreign.gltf.primitives import PlacedPrimitive
from storage.errors import Rejected


class WorldTriangles:
    """World-space triangles of a placed primitive."""

    def __init__(self, primitive: PlacedPrimitive) -> None:
        """Drop triangles without an area; raise Rejected where positions are not finite."""
        self._primitive = primitive
        corners = primitive.positions[primitive.faces]
        if not np.isfinite(corners).all():
            raise Rejected("nonfinite_vertices", "positions are not finite")
        wide = corners.astype(np.float32).astype(np.float64)
        cross = np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
        self._has_area = have_areas(wide, cross)
        self.num_without_area = int((~self._has_area).sum())
        self.positions = wide[self._has_area].astype(np.float32)
        """[T, 3, 3] corners in world space, in meters."""
        length = np.linalg.norm(cross[self._has_area], axis=1, keepdims=True)
        self._flat = np.repeat((cross[self._has_area] / length)[:, None], 3, axis=1)

    @property
    def colors(self) -> NDArray[np.float64] | None:
        """Linear colors [T, 3, 3] of the corners; None where the file has none."""
        return self._select(self._primitive.colors)

    @property
    def normals(self) -> NDArray[np.float32]:
        """Unit normals [T, 3, 3]; flat ones where the file has none."""
        normals = self._select(self._primitive.normals)
        normals = self._flat if normals is None else normals
        length = np.linalg.norm(normals, axis=2, keepdims=True)
        usable = np.isfinite(length) & (length > 0)
        return np.where(usable, normals / np.where(usable, length, 1), self._flat).astype(
            np.float32
        )

    def coordinates(self, number: int) -> NDArray[np.float64] | None:
        """Return a set of texture coordinates [T, 3, 2], v up; None where it is missing.

        Raises:
            Rejected: a coordinate is not finite.
        """
        uv = self._select(self._primitive.coordinates(number))
        if uv is not None and not np.isfinite(uv).all():
            raise Rejected("texture_coordinates_not_finite", f"TEXCOORD_{number} is not finite")
        return uv

    def _select(self, values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        return None if values is None else values[self._has_area]
