"""Cameras: they look near the origin from the open side of a layout."""

from dataclasses import dataclass

import numpy as np

from scene_templates.checks import Range, check_numbers, require
from scene_templates.layout import CameraPose
from scene_templates.templates.sectors import Sector
from storage.conventions import look_at_c2w


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """What cameras are drawn from, as published."""

    distance: Range = (1.5, 2.0)
    """From the camera to the point it looks at, world units."""
    target_jitter: float = 0.2
    """Most offset per axis from the origin of the point it looks at."""
    up_jitter: float = 0.1
    """Most offset per axis of a camera's up vector from +Z."""
    fov_deg: Range = (30.0, 60.0)
    """Full field of view, horizontal and vertical."""

    def __post_init__(self) -> None:
        check_numbers(self)
        require(self.distance[0] > 0, "distance", self.distance, "numbers above 0")
        fits = 0 < self.fov_deg[0] and self.fov_deg[1] < 180
        require(fits, "fov_deg", self.fov_deg, "degrees above 0 and below 180")


def camera_rand(rng: np.random.Generator, settings: CameraSettings, sector: Sector) -> CameraPose:
    """Draw one camera. Whether it sees anything is for the caller to find out."""
    target = rng.uniform(-settings.target_jitter, settings.target_jitter, size=3)
    eye = target + rng.uniform(*settings.distance) * sector.direction_rand(rng)
    up = np.array([0, 0, 1]) + rng.uniform(-settings.up_jitter, settings.up_jitter, size=3)
    return CameraPose(
        c2w=look_at_c2w(eye=eye, target=target, up=up),
        fov_deg=float(rng.uniform(*settings.fov_deg)),
    )
