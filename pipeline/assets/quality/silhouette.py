"""Comparison of outlines over several directions."""

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.outside_rays import first_faces, outside_rays
from pipeline.foreign.mesh import TriangleMesh

_DIRECTIONS = 8
_RAYS_PER_SIDE = 64
"""The ray spacing is 2.8 % of the box: one ray in forty hits the outline of a large object."""


def silhouette(mesh: TriangleMesh) -> NDArray[np.bool_]:
    """Return True for each ray of a fixed set around the unit box that hits the mesh."""
    return first_faces(mesh, *outside_rays(_DIRECTIONS, _RAYS_PER_SIDE)) >= 0


def intersection_over_union(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Return the number of rays that hit both over the number that hit either."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 1.0
