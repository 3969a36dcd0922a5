"""Poses (transforms) an asset's mesh in the scene: centers, scales, rotates and moves it."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scene_templates.layout import Pose
from scene_templates.rotations import rotate_points

SMALLEST_DOUBLE_AREA = 1e-12
"""A triangle of a square micrometre: no ray meets it, and its normal is rounding."""


def normalize_to_unit_sphere(
    positions: NDArray[np.float32], centring: Literal["vertex_mean", "box"]
) -> NDArray[np.float64]:
    """Return the vertices [V, 3] of a level scaled so that the farthest lies on the unit sphere.

    Args:
        positions: [V, 3] in the unit box of the asset, whose middle is that of its source.
        centring: the new center: that middle, which is the same for all levels of an asset, or as
            published the mean of the vertices, which moves with the tessellation.

    Returns:
        float64; not finite if a position is not, or if all positions are the same point.
    """
    points = positions.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        if centring == "vertex_mean":
            points -= points.mean(axis=0)
        return points / np.sqrt(np.sum(np.square(points), axis=1).max())


def pose_points(points: NDArray[np.float64], pose: Pose) -> NDArray[np.float32]:
    """Return points [V, 3] of the unit sphere in world space."""
    return (pose.radius * rotate_points(points, pose.rotation) + pose.centre).astype(np.float32)


def not_slivers(positions: NDArray[np.float32], faces: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Return a mask [F] of the faces that have an area after rounding to float32."""
    corners = positions.astype(np.float64)[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    has_area: NDArray[np.bool_] = np.sqrt(np.sum(np.square(cross), axis=1)) > SMALLEST_DOUBLE_AREA
    return has_area


def without_slivers(
    positions: NDArray[np.float32], faces: NDArray[np.uint32]
) -> NDArray[np.uint32]:
    """Return the faces that have an area after rounding to float32."""
    return faces[not_slivers(positions, faces)]
