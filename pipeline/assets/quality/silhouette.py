"""What a camera notices first: the outline, compared over many directions."""

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.outside_rays import first_faces, outside_rays
from pipeline.foreign.mesh import TriangleMesh

_DIRECTIONS = 8
_RAYS_PER_SIDE = 64
"""Rays are 2.8 % of the box apart: one in forty of a large object lies on its outline."""


def silhouette(mesh: TriangleMesh) -> NDArray[np.bool_]:
    """Return which rays of a fixed set around the unit box meet the mesh."""
    return first_faces(mesh, *outside_rays(_DIRECTIONS, _RAYS_PER_SIDE)) >= 0


def intersection_over_union(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Return the share of the rays meeting either that meet both, over all directions together."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 1.0
