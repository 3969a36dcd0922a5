"""Cells of a scene's surfaces: path guiding learns directions for each of them.

Each triangle is cut into a grid of cells of bounded size, apart for its two sides.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import own_integers

_CELLS = 1500
"""A cell is about as large as so many parts of the scene's whole surface, or smaller."""

_MOST_CUTS = 64
"""Most cells along an edge of a triangle."""


class GuideCells:
    """The cells of triangles. Not a dataclass: Dr.Jit would take its arrays for loop variables."""

    def __init__(self, corners: NDArray[np.float64]) -> None:
        """Cut triangles, [T, 3, 3], into cells."""
        edge1 = corners[:, 1] - corners[:, 0]
        edge2 = corners[:, 2] - corners[:, 0]
        normal = np.cross(edge1, edge2)
        area = 0.5 * np.linalg.norm(normal, axis=1)
        self.size_m = max(float(np.sqrt(area.sum() / _CELLS)), np.finfo(np.float32).tiny)
        """About the width of the largest cells."""
        cuts = np.clip(np.ceil(np.sqrt(area) / self.size_m), 1, _MOST_CUTS).astype(np.int64)
        first = np.cumsum(2 * cuts**2) - 2 * cuts**2
        self._rows = own_integers(np.column_stack([first, cuts]))
        triangle = np.repeat(np.arange(len(cuts)), 2 * cuts**2)
        column, row, self._front = _places(
            np.arange(len(triangle)) - first[triangle], cuts[triangle]
        )
        u, v = ((place + 0.5) / cuts[triangle] for place in (column, row))
        is_beyond = u + v > 1
        u, v = np.where(is_beyond, (1 - v, 1 - u), (u, v))
        self.centres_m = (
            corners[triangle, 0] + u[:, None] * edge1[triangle] + v[:, None] * edge2[triangle]
        )
        """[C, 3] a point of each cell; of cells beyond the triangle's third edge, one nearby."""
        outward = normal[triangle] * np.where(self._front, 1.0, -1.0)[:, None]
        axis = np.abs(outward).argmax(axis=1)
        self.facing = 2 * axis + (outward[np.arange(len(axis)), axis] > 0)
        """[C] 0 to 5: the axis and the sign of the largest component of the normal."""

    def index(self, triangle: Any, barycentric: Any, front: Any, active: Any) -> Any:
        """Return the cell (UInt32) of a point; `front` says which side of the triangle it is."""
        row = dr.gather(mi.Vector2u, self._rows, triangle, active)
        first = row.x
        cuts = row.y
        column, line = (
            dr.minimum(mi.UInt32(dr.maximum(weight, 0) * mi.Float(cuts)), cuts - 1)
            for weight in barycentric
        )
        return first + 2 * (line * cuts + column) + dr.select(front, mi.UInt32(1), mi.UInt32(0))


def _places(
    number: NDArray[np.int64], cuts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return column, row and side of cells from their numbers within their triangles."""
    square = number // 2
    return square % cuts, square // cuts, number % 2 == 1
