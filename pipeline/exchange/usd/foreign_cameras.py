"""Reads the cameras of a USD stage as poses and angles of square pictures."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.cameras import rigid_pose
from pipeline.exchange.usd.names import FOV_DEG
from pipeline.foreign.numbers import read_number
from pipeline.foreign.usd.placed import PlacedPrim

_SAME_LENS = 1e-5
"""Relative tolerance for a lens that Trilight wrote."""


def read_stage_camera(
    placed: PlacedPrim, time: Any, lost: list[str]
) -> tuple[NDArray[np.float64], float] | None:
    """Return pose [4, 4] and full angle in degrees of a camera; None for an unusable one."""
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
