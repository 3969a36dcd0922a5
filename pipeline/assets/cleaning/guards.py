"""Checks of a source before and after cleaning, each with its reason code."""

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected

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
    double_areas = np.linalg.norm(mesh.double_area_vectors, axis=1)
    area = 0.5 * float(double_areas.sum())
    bulk = _bulk_extent(mesh.corners.reshape(-1, 3), np.repeat(double_areas, 3)) if area else 0.0
    if area and bulk < MIN_BULK:
        raise Rejected(
            "far_outlier", f"99 % of the area lies within {bulk:.2g} of the box; >= {MIN_BULK}"
        )
    if area < MIN_AREA:
        raise Rejected("degenerate", f"area {area:.3g} in the unit box; expected >= {MIN_AREA}")


def _bulk_extent(points: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the longest side of the box without the outer 0.5 % of the area at either end."""
    sides = []
    for axis in points.T:
        order = np.argsort(axis, kind="stable")
        cumulative = np.cumsum(weights[order])
        low, high = np.searchsorted(cumulative, [0.005 * cumulative[-1], 0.995 * cumulative[-1]])
        sides.append(float(axis[order[min(high, len(order) - 1)]] - axis[order[low]]))
    return max(sides)
