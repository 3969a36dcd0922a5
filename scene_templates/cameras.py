"""Cameras: they look near the origin from the open side of a layout."""

import numpy as np

from scene_templates.layout import CameraPose
from scene_templates.sectors import Sector
from scene_templates.settings import SceneSettings
from storage.conventions import look_at_c2w


def camera_rand(rng: np.random.Generator, settings: SceneSettings, sector: Sector) -> CameraPose:
    """Draw one camera. Whether it sees anything is for the caller to find out."""
    target = rng.uniform(-settings.target_jitter, settings.target_jitter, size=3)
    eye = target + rng.uniform(*settings.camera_distance) * sector.direction_rand(rng)
    up = np.array([0, 0, 1]) + rng.uniform(-settings.up_jitter, settings.up_jitter, size=3)
    return CameraPose(
        c2w=look_at_c2w(eye=eye, target=target, up=up),
        fov_deg=float(rng.uniform(*settings.fov_deg)),
    )
