"""Reads the cameras of a USD stage as poses and angles of square pictures."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.names import FOV_DEG
from pipeline.foreign.numbers import read_number
from pipeline.foreign.usd.placed import PlacedPrim
from storage.conventions import look_at_c2w

_FOV_DEG = 40.0
"""Field of view of the camera that is added to a stage without cameras."""
_SAME_LENS = 1e-5
"""Relative tolerance for a lens that Trilight wrote."""


def read_stage_cameras(
    placed: Sequence[PlacedPrim], time: Any, lost: list[str]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return poses [C, 4, 4] and full angles [C] in degrees of the usable cameras."""
    poses = []
    angles = []
    for each in placed:
        pose_and_angle = _read_camera(each, time, lost)
        if pose_and_angle is not None:
            poses.append(pose_and_angle[0])
            angles.append(pose_and_angle[1])
    return np.array(poses, np.float32).reshape(-1, 4, 4), np.array(angles, np.float32)


def fit_camera(
    points: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the pose and angle of a camera that sees all points [N, 3], obliquely from above."""
    low = points.min(axis=0).astype(np.float64)
    high = points.max(axis=0).astype(np.float64)
    center = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    direction = np.array([0.6, -1.0, 0.6]) / np.linalg.norm([0.6, -1.0, 0.6])
    eye = center + direction * radius / math.sin(math.radians(_FOV_DEG) / 2)
    pose = look_at_c2w(eye=eye, target=center, up=[0, 0, 1])
    return pose[None].astype(np.float32), np.array([_FOV_DEG], np.float32)


def _read_camera(
    placed: PlacedPrim, time: Any, lost: list[str]
) -> tuple[NDArray[np.float64], float] | None:
    from pxr import UsdGeom

    camera = UsdGeom.Camera(placed.prim)
    where = placed.prim.GetPath()
    lens = (
        camera.GetFocalLengthAttr(),
        camera.GetHorizontalApertureAttr(),
        camera.GetVerticalApertureAttr(),
    )
    focal, wide, high = (read_number(each.Get(time), str(each.GetPath())) for each in lens)
    pose = rigid_pose(placed.to_world)
    if camera.GetProjectionAttr().Get(time) != "perspective" or pose is None or not focal > 0:
        lost.append(f"{where}: no perspective camera with a focal length")
        return None
    angle = math.degrees(2 * math.atan(wide / (2 * focal)))
    held = placed.prim.GetAttribute(FOV_DEG).Get(time)
    is_held = isinstance(held, float) and math.isclose(held, angle, rel_tol=_SAME_LENS)
    if not is_held and not math.isclose(wide, high, rel_tol=1e-4):
        lost.append(f"{where}: pictures are square; its horizontal angle was used")
    if any(a.Get(time) for a in (camera.GetHorizontalApertureOffsetAttr(),
                                 camera.GetVerticalApertureOffsetAttr())):  # fmt: skip
        lost.append(f"{where}: its shift has no place here")
    if camera.GetFStopAttr().Get(time):
        lost.append(f"{where}: depth of field has no place here")
    angle = held if is_held else angle
    return (pose, angle) if 0 < angle < 180 else None


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
