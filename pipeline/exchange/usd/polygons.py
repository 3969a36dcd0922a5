"""Polygons into triangles: fans where they are convex, ears cut off where they are not."""

import numpy as np
from numpy.typing import NDArray

MAX_EAR_CORNERS = 2000
"""Of a polygon that is not convex; larger ones are cut as fans."""


def triangulated(
    points: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the triangles of polygons.

    Args:
        points: [P, 3].
        counts: [F] corners of each polygon.
        indices: [sum of counts] rows of `points`.

    Returns:
        Corners [T, 3], as positions within `indices`, and the polygon [T] of each. Polygons of
        fewer than three corners give none.
    """
    starts = np.cumsum(counts) - counts
    corners: list[NDArray[np.int64]] = []
    owners: list[NDArray[np.int64]] = []
    for count in np.unique(counts[counts >= 3]):
        faces = np.flatnonzero(counts == count)
        fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
        cut = starts[faces, None, None] + fan
        if 3 < count <= MAX_EAR_CORNERS:
            for row in np.flatnonzero(_folded(points[indices[cut]])):
                ring = starts[faces[row]] + np.arange(count)
                cut[row] = ring[_ears(points[indices[ring]])]
        corners.append(cut.reshape(-1, 3))
        owners.append(np.repeat(faces, count - 2))
    if not corners:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    joined, owner = np.concatenate(corners), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return joined[order], owner[order]


def _folded(fans: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for fans [F, N, 3, 3] whether a triangle faces away from its polygon."""
    cross = np.cross(fans[:, :, 1] - fans[:, :, 0], fans[:, :, 2] - fans[:, :, 0])
    facing = np.einsum("fni,fi->fn", cross, cross.sum(axis=1))
    return np.asarray((facing < 0).any(axis=1))


def _ears(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the triangles [N - 2, 3] of one polygon [N, 3], by cutting off ears."""
    flat = _flattened(points)
    ring = list(range(len(flat)))
    found = []
    while len(ring) > 3:
        at = next((i for i in range(len(ring)) if _is_ear(flat, ring, i)), 0)
        found.append([ring[at - 1], ring[at], ring[(at + 1) % len(ring)]])
        del ring[at]
    return np.array([*found, ring])


def _flattened(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a polygon [N, 2] in the plane of its normal, counter-clockwise."""
    ahead = np.roll(points, -1, axis=0)
    normal = np.cross(points, ahead).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    flat = np.delete(points, axis, axis=1)
    mirrored = (normal[axis] < 0) != (axis == 1)
    return flat * np.array([-1.0, 1.0]) if mirrored else flat


def _is_ear(flat: NDArray[np.float64], ring: list[int], at: int) -> bool:
    before, here, after = ring[at - 1], ring[at], ring[(at + 1) % len(ring)]
    a, b, c = flat[before], flat[here], flat[after]
    if _turn(a, b, c) <= 0:
        return False
    others = [i for i in ring if i not in (before, here, after)]
    return not any(
        _turn(a, b, flat[i]) >= 0 and _turn(b, c, flat[i]) >= 0 and _turn(c, a, flat[i]) >= 0
        for i in others
    )


def _turn(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
