"""Mesh cleaning: unit box, welded, no degenerate or repeated face, canonical order.

Clean positions lie on a grid of 2^-20 of the box. The grid welds vertices (equal cells are one
vertex), decides zero area exactly in integers, passes through float32 unchanged, and makes the
result independent of the source's scale, offset and order of vertices and faces. The price is a
shift of at most 5e-7 of the box, and that two vertices closer than one cell may stay separate where
the border of a cell runs between them. Checks before and after have a reason code each.
"""

import hashlib

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected

GRID = 1 << 20
"""Cells along the longest side of the box."""

_BITS = 21
_OFFSET = 1 << (_BITS - 1)
"""A coordinate of the grid lies within +-2^20 and takes 21 bits of a 63-bit key."""

_DIGEST_SHIFT = 3
"""The digest uses cells eight times as wide (7.6e-6), so that most copies that went through another
number format still share it."""


def normalize(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with its bounding box centered on the origin, the longest side being 1.

    Vertices that no face uses are dropped. The mesh must be finite and have an extent.
    """
    used, flat = np.unique(mesh.faces, return_inverse=True)
    positions = mesh.positions[used]
    low = positions.min(axis=0)
    high = positions.max(axis=0)
    positions = (positions - (low + high) / 2) / (high - low).max()
    return TriangleMesh(positions=positions, faces=flat.reshape(-1, 3))


def clean(mesh: TriangleMesh) -> TriangleMesh:
    """Weld a mesh in the unit box, and return a clean copy; it may have no faces left.

    Vertices are sorted by position, faces by vertex, each starting at its lowest vertex. Faces with
    the same three vertices become one, whatever their windings: orientation comes later.
    """
    cells = np.rint(mesh.positions * GRID).astype(np.int64)
    keys = _keys(cells)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    cells = cells[first]
    faces = inverse[mesh.faces]
    a, b, c = cells[faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)  # exact, because products stay below 2^43
    faces = canonical(faces[(normal != 0).any(axis=1)])
    if len(faces):
        _, keep = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
        faces = faces[np.sort(keep)]
    used, flat = np.unique(faces, return_inverse=True)
    return TriangleMesh(positions=cells[used] / GRID, faces=flat.reshape(-1, 3))


def canonical(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rotate every face to start at its lowest vertex, and sort the faces."""
    rotated = start_at_lowest(faces)
    return rotated[np.lexsort(rotated.T[::-1])]


def start_at_lowest(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rotate every face to start at its lowest vertex."""
    corner_order = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces, corner_order, axis=1)


def geometry_sha256(mesh: TriangleMesh) -> str:
    """Return the digest of a clean mesh, equal for near-duplicates.

    Order and winding of its faces do not count, nor do positions below the grid of the digest.
    """
    cells = np.rint(mesh.positions * GRID).astype(np.int64)
    coarse = _keys((cells + (1 << _DIGEST_SHIFT >> 1)) >> _DIGEST_SHIFT)
    corners = np.unique(np.sort(coarse[mesh.faces], axis=1), axis=0)
    return hashlib.sha256(corners.astype("<i8").tobytes()).hexdigest()


def cell_keys(positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return one integer per position [V, 3] of the unit box; equal ones are welded."""
    return _keys(np.rint(positions * GRID).astype(np.int64))


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one integer per row that orders rows lexicographically."""
    shifted = cells + _OFFSET
    return (shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2]


EXTENT_RANGE = (1e-9, 1e9)
"""Accepted longest side of the bounding box, in the units of the file."""

MAX_OFFSET = 1e5
"""Largest distance from the origin, in extents: beyond it, float32 errors reach 1 % of the object.
"""

MIN_AREA = 1e-5
"""Smallest area of an object in the unit box: as long as the box and 1e-5 around."""

MIN_BULK = 0.02
"""Smallest longest side of the box that holds 99 % of the area, in the unit box; below it, a few
far vertices have shrunk the object to a dot."""


def check_raw(mesh: TriangleMesh, settings: AssetSettings, *, is_single: bool) -> None:
    """Raise Rejected where a loaded mesh is too large, not finite, or out of range.

    Args:
        mesh: as loaded, in the units of the file.
        settings: the limits.
        is_single: True where the file stores positions in single precision.
    """
    if len(mesh.faces) > settings.max_source_faces:
        raise Rejected(
            "too_many_faces", f"{len(mesh.faces)} faces; expected <= {settings.max_source_faces}"
        )
    used = mesh.positions[np.unique(mesh.faces)]
    if not np.isfinite(used).all():
        bad = int((~np.isfinite(used)).any(axis=1).sum())
        raise Rejected("nonfinite_vertices", f"{bad} of {len(used)} vertices are not finite")
    with np.errstate(over="ignore"):
        low = used.min(axis=0)
        high = used.max(axis=0)
        extent = float((high - low).max())
        offset = float(np.abs(0.5 * low + 0.5 * high).max())
    if not EXTENT_RANGE[0] <= extent <= EXTENT_RANGE[1]:
        raise Rejected("extent_range", f"longest side {extent:.3g}; expected {EXTENT_RANGE}")
    if is_single and offset > MAX_OFFSET * extent:
        raise Rejected(
            "offset_precision",
            f"the object is {offset / extent:.3g} times its size away from the origin",
        )


def check_clean(mesh: TriangleMesh) -> None:
    """Raise Rejected where a cleaned mesh has too little area to render."""
    areas = mesh.areas
    area = float(areas.sum())
    if area:
        points = mesh.corners.reshape(-1, 3)
        weights = np.repeat(areas, 3)
        ends = (0.005, 0.995)
        sides = (  # one after another: all at once take twice the memory
            np.quantile(axis, ends, weights=weights, method="inverted_cdf") for axis in points.T
        )
        bulk = float(max(map(np.ptp, sides)))
        if bulk < MIN_BULK:
            raise Rejected(
                "far_outlier", f"99 % of the area lies within {bulk:.2g} of the box; >= {MIN_BULK}"
            )
    if area < MIN_AREA:
        raise Rejected("degenerate", f"area {area:.3g} in the unit box; expected >= {MIN_AREA}")
