"""Poses of cameras in scenes of other programs."""

import math

import numpy as np
from numpy.typing import NDArray

from storage.conventions import look_at_c2w

_FOV_DEG = 40.0
"""Field of view of the camera that is added to a scene without cameras."""


def fit_camera(points: NDArray[np.float32]) -> tuple[NDArray[np.float64], float]:
    """Return the pose and angle of a camera that sees all points [N, 3], obliquely from above."""
    low = points.min(axis=0).astype(np.float64)
    high = points.max(axis=0).astype(np.float64)
    center = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    direction = np.array([0.6, -1.0, 0.6]) / np.linalg.norm([0.6, -1.0, 0.6])
    eye = center + direction * radius / math.sin(math.radians(_FOV_DEG) / 2)
    return look_at_c2w(eye=eye, target=center, up=[0, 0, 1]), _FOV_DEG


def rigid_pose(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return a transform [4, 4] without its scale; None where it has no direction."""
    backward = matrix[:3, 2]
    right = matrix[:3, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        backward = backward / np.linalg.norm(backward)
        right = right - backward * np.einsum("i,i->", right, backward)
        right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    pose[:3, 3] = matrix[:3, 3]
    return pose if np.isfinite(pose).all() else None
