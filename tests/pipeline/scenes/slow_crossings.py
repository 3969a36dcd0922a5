"""Do two meshes meet? Every edge of one against every triangle of the other, in plain numpy.

The slow twin of pipeline.scenes.shapes: no trees, no library.
"""

import numpy as np
from numpy.typing import NDArray

CHUNK = 64


def cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether two triangle soups [T, 3, 3] cut each other.

    Triangles that cut each other, and do not lie in one plane, have an edge of one through the
    inside of the other. Mere touching is left open.
    """
    return _edges_cut(one, other) or _edges_cut(other, one)


def _edges_cut(soup: NDArray[np.float64], triangles: NDArray[np.float64]) -> bool:
    start = soup.reshape(-1, 3)
    along = (np.roll(soup, -1, axis=1) - soup).reshape(-1, 3)
    near = _boxes_near(start, start + along, triangles.reshape(-1, 3))
    start, along = start[near], along[near]
    a, ab, ac = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    for rows in np.array_split(np.arange(len(start)), max(1, len(start) // CHUNK)):
        p = np.cross(along[rows, None], ac[None])
        det = np.sum(p * ab, axis=-1)
        away = start[rows, None] - a
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.sum(p * away, axis=-1) / det
            q = np.cross(away, ab[None])
            v = np.sum(along[rows, None] * q, axis=-1) / det
            t = np.sum(q * ac, axis=-1) / det
            inside = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)
        if inside.any():
            return True
    return False


def _boxes_near(
    start: NDArray[np.float64], end: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether segments come into the box of some points."""
    low, high = points.min(axis=0), points.max(axis=0)
    below = np.maximum(start, end) < low
    above = np.minimum(start, end) > high
    return np.asarray(~(below | above).any(axis=1))


def encloses(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether the box of one soup lies in the box of the other."""
    low, high = one.min(axis=(0, 1)), one.max(axis=(0, 1))
    other_low, other_high = other.min(axis=(0, 1)), other.max(axis=(0, 1))
    inside = (low >= other_low).all() and (high <= other_high).all()
    outside = (low <= other_low).all() and (high >= other_high).all()
    return bool(inside or outside)
