"""Emission of a level's triangles: the mean of the source's emission over each."""

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.source_materials.nearest import SurfaceLookup
from pipeline.assets.source_materials.source_surface import SourceSurface
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.picture import spread_points
from storage.errors import Rejected

_LEAST = 0.05
"""Fraction of the brightest triangle's radiance below which a triangle emits nothing."""
_MOST = 1e30
"""Radiance from which on a number is refused."""


def level_emission(
    level: TriangleMesh, source: SourceSurface, nearest: SurfaceLookup, reach: float
) -> NDArray[np.float32] | None:
    """Return the radiance [F, 3] of a level's triangles; None where nothing emits.

    Args:
        level: mesh in the unit box.
        source: surface of the source.
        nearest: lookup of points on that surface.
        reach: largest distance to the source, in the unit box.

    Raises:
        Rejected: materials_unreadable where the radiance is not a number, or too large for float32.
    """
    if not source.emits:
        return None
    weights = spread_points()
    corners = level.corners
    points = np.einsum("pc,fcd->fpd", weights, corners)
    normal = level.double_area_vectors
    areas = 0.5 * np.linalg.norm(normal, axis=1)
    normals = np.repeat(normal / (2 * areas[:, None]), len(weights), axis=0)
    locations = nearest.find(points.reshape(-1, 3), normals, reach)
    cell = float(np.sqrt(np.median(areas) / len(weights)))
    seen = source.emission(locations.faces, locations.weights, cell).reshape(len(corners), -1, 3)
    mean = seen.mean(axis=1)
    if not mean.max() < _MOST:  # or not a number
        raise Rejected("materials_unreadable", f"a surface emits {mean.max():.3g}; < {_MOST:g}")
    brightness = mean.mean(axis=1)
    mean[brightness < _LEAST * brightness.max()] = 0
    return mean.astype(np.float32) if mean.any() else None
