"""Cameras of a scene as USD: a pose, and a lens in tenths of a metre on a square film of 36 mm."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.authoring import Attributes, add_attributes, add_prim
from pipeline.exchange.usd.names import FOV_DEG, camera_name
from storage.records.scene import Scene

APERTURE = 0.36
"""Width and height of the film in tenths of a metre."""

CLIP_METRES = (1e-3, 1e4)


def add_cameras(layer: Any, folder: str, scene: Scene) -> None:
    """Write a prim for each camera below `folder`."""
    add_prim(layer, folder, "Scope")
    for row in range(scene.num_views):
        camera = add_prim(layer, f"{folder}/{camera_name(row)}", "Camera")
        add_attributes(camera, camera_attributes(scene.c2w[row], float(scene.fov_deg[row])))


def camera_attributes(c2w: NDArray[np.float32], fov_deg: float) -> Attributes:
    """Return what stands on a camera's prim: pose [4, 4], and full field of view in degrees."""
    focal = APERTURE / (2 * math.tan(math.radians(fov_deg) / 2))
    rows = c2w.astype(np.float64).T.tolist()  # USD multiplies rows from the left
    return {
        "xformOp:transform": ("matrix4d", rows),
        "xformOpOrder": ("uniform token[]", ("xformOp:transform",)),
        "projection": ("token", "perspective"),
        "focalLength": ("float", float(np.float32(focal))),
        "horizontalAperture": ("float", float(np.float32(APERTURE))),
        "verticalAperture": ("float", float(np.float32(APERTURE))),
        "clippingRange": ("float2", CLIP_METRES),
        FOV_DEG: ("float", fov_deg),
    }
