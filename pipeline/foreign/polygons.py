"""Triangulation of polygons: fans where they are convex, ear clipping where they are not."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.errors import Rejected

_MOST_FROM_START = 2000
"""Corners of a polygon up to which the first ear is cut; larger ones continue after the last."""


def check_indices(indices: NDArray[np.int64], count: int, first: int = 0) -> None:
    """Raise Rejected for an index beyond `count` vertices; messages count from `first`."""
    if len(indices) and not (0 <= indices.min() and indices.max() < count):
        bad = first + (indices.min() if indices.min() < 0 else indices.max())
        raise Rejected("index_range", f"a face names vertex {bad} of {count} from {first} on")


@dataclass(frozen=True, kw_only=True, eq=False)
class CutPolygons:
    """The triangles of a file's polygons."""

    corners: NDArray[np.int64]
    """[T, 3] positions within the indices of the polygons."""
    owner: NDArray[np.int64]
    """[T] polygon of each triangle."""
    vertices: NDArray[np.int64]
    """[T, 3] rows of the points."""

    def spread_colors(
        self, by_vertex: NDArray[np.float64] | None, by_face: NDArray[np.float64] | None
    ) -> NDArray[np.float64] | None:
        """Return colors [T, 3, 3] at corners: of vertices [V, 3], or else of polygons [F, 3]."""
        if by_vertex is not None:
            return by_vertex[self.vertices]
        return None if by_face is None else np.repeat(by_face[self.owner][:, None], 3, axis=1)


def cut_polygons(
    points: NDArray[np.float64],
    counts: NDArray[np.int64],
    indices: NDArray[np.int64],
    unread: Counter[str],
) -> CutPolygons:
    """Cut polygons into triangles; arguments as for `triangulate`, and the counter of unread parts.

    Raises:
        Rejected: index_range.
    """
    check_indices(indices, len(points))
    if few := int((counts < 3).sum()):
        unread["faces with fewer than three corners"] = few
    corners, owner = triangulate(points, counts, indices)
    corners, owner = sort_by_size(corners, owner, counts, np.zeros_like(counts))
    return CutPolygons(corners=corners, owner=owner, vertices=indices[corners])


def triangulate(
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
    corners = [np.zeros((0, 3), np.int64)]
    owners = [np.zeros(0, np.int64)]
    for count in np.unique(counts[counts >= 3]):
        faces = np.flatnonzero(counts == count)
        fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
        cut = starts[faces, None, None] + fan
        if count > 3:
            for row in np.flatnonzero(_is_folded(points[indices[cut]])):
                ring = starts[faces[row]] + np.arange(count)
                cut[row] = ring[_cut_ears(points[indices[ring]])]
        corners.append(cut.reshape(-1, 3))
        owners.append(np.repeat(faces, count - 2))
    triangles = np.concatenate(corners)
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return triangles[order], owner[order]


def sort_by_size(
    corners: NDArray[np.int64],
    owner: NDArray[np.int64],
    counts: NDArray[np.int64],
    group: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort triangles by group, then as scenes hold them since the first release.

    Args:
        corners: [T, 3], as `triangulate` returns them.
        owner: [T] polygon of each triangle.
        counts: [F] corners of each polygon.
        group: [F]; within one, triangles come first, then the halves of four corners, each half
            together, then the others. A negative group keeps the order of its polygons.
    """
    piece = np.arange(len(owner)) - np.searchsorted(owner, owner)
    size = counts[owner]
    second = (size == 4) & (piece == 1)
    corners = np.where(second[:, None], np.roll(corners, -1, axis=1), corners)
    kind = np.where(size == 3, 0, np.where(size == 4, 1 + piece, 3))
    of_group = group[owner]
    order = np.lexsort((np.where(of_group < 0, 0, kind), np.abs(of_group)))
    return corners[order], owner[order]


def _is_folded(fans: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether a triangle of each fan [F, N, 3, 3] faces away from its polygon."""
    cross = np.cross(fans[:, :, 1] - fans[:, :, 0], fans[:, :, 2] - fans[:, :, 0])
    facing = np.einsum("fni,fi->fn", cross, cross.sum(axis=1))
    return np.asarray((facing < 0).any(axis=1))


def _cut_ears(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the triangles [N - 2, 3] of one polygon [N, 3] by ear clipping.

    A corner at the position of another one, as where a cut leads to a hole, blocks no ear.
    """
    flat = _project_to_plane(points)
    x = flat[:, 0].copy()
    y = flat[:, 1].copy()
    is_uncut = np.ones(len(flat), np.bool_)
    before = [len(flat) - 1, *range(len(flat) - 1)]
    after = [*range(1, len(flat)), 0]
    triangles = []
    at = 0
    num_tried = 0
    for size in range(len(flat), 3, -1):
        while num_tried < size and not _is_ear(x, y, is_uncut, before[at], at, after[at]):
            at = after[at]
            num_tried += 1
        triangles.append([before[at], at, after[at]])
        is_uncut[at] = False
        before[after[at]], after[before[at]] = before[at], after[at]
        at = int(is_uncut.argmax()) if len(flat) <= _MOST_FROM_START else after[at]
        num_tried = 0
    return np.array([*triangles, [before[at], at, after[at]]])


def _project_to_plane(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a polygon [N, 2] projected along an axis near its normal, counter-clockwise."""
    points = points - points[0]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    flat = np.delete(points, axis, axis=1)
    mirrored = (normal[axis] < 0) != (axis == 1)
    return flat * np.array([-1.0, 1.0]) if mirrored else flat


def _is_ear(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    is_uncut: NDArray[np.bool_],
    a: int,
    b: int,
    c: int,
) -> bool:
    """Return whether no other uncut corner lies within the triangle of `a`, `b` and `c`."""

    def cross(i: int, j: int) -> NDArray[np.float64]:
        return (x[j] - x[i]) * (y - y[i]) - (y[j] - y[i]) * (x - x[i])

    if (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]) <= 0:
        return False
    inside = is_uncut & (cross(a, b) >= 0) & (cross(b, c) >= 0) & (cross(c, a) >= 0)
    for corner in (a, b, c):
        inside &= (x != x[corner]) | (y != y[corner])
    return not inside.any()
