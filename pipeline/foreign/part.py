"""`Part`: triangles of a file with one material, as a scene holds them: meters, +Z up."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import SourceMaterial

_SMALLEST_DOUBLE_AREA = 1e-12
"""Twice the area of a triangle, in square meters, below which it counts as empty."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Triangles with one material, each with three separate corners."""

    where: str
    """Beginning of notes, such as the path of a mesh with a colon; may be empty."""
    material: SourceMaterial
    """Material of every triangle, as the file states it."""
    positions: NDArray[np.float32]
    """[T, 3, 3] corners in world space; every triangle has an area."""
    normals: NDArray[np.float32]
    """[T, 3, 3] unit normals at the corners."""
    coordinates: Callable[[int], NDArray[np.float64] | None]
    """Returns a set of texture coordinates [T, 3, 2], v up; None where it is missing."""
    colors: NDArray[np.float64] | None
    """[T, 3, 3] linear tints of the corners, multiplied with the base color; None for white."""


def drop_empty(
    corners: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]:
    """Return triangles [T, 3, 3] that have an area, their unit normals [T, 3], and a mask of them.

    In a mesh smaller than a meter the least area shrinks with its size: triangles of a watch are
    small.
    """
    positions = corners.astype(np.float32)
    wide = positions.astype(np.float64)
    cross = np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
    size = min(float(np.ptp(wide.reshape(-1, 3), axis=0).max()), 1.0) if wide.size else 1.0
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    has_area: NDArray[np.bool_] = length[:, 0] > _SMALLEST_DOUBLE_AREA * size**2
    return positions[has_area], cross[has_area] / length[has_area], has_area


def unit_normals(
    stated: NDArray[np.float64] | None, flat: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return unit normals [T, 3, 3] at corners; `flat` [T, 3] where none of a length is stated."""
    if stated is None:
        return np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
    length = np.linalg.norm(stated, axis=2, keepdims=True)
    usable = np.isfinite(length) & (length > 0)
    unit = np.where(usable, stated / np.where(usable, length, 1), flat[:, None])
    return np.asarray(unit, np.float32)
