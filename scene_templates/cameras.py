"""Cameras, which look near the origin from a sector of directions: the open side of a layout."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import OFFSET, SIZE, Range, require
from scene_templates.layout import CameraPose
from storage.conventions import look_at_c2w
from storage.settings.described import checked
from storage.settings.ranges import Within


@dataclass(frozen=True, kw_only=True)
class Sector:
    """Directions between two elevations and within an angle of one azimuth."""

    azimuth_deg: float
    """Middle of the sector; 0 is +X, 90 is +Y."""
    half_width_deg: float
    """Largest angle to either side of the azimuth; 180 is all around."""
    elevation_deg: tuple[float, float]
    """Least and greatest angle above the horizon."""

    def __post_init__(self) -> None:
        """Raise TrilightError for angles that no direction has."""
        low, high = self.elevation_deg
        require(-90 <= low <= high <= 90, "elevation_deg", (low, high), "two from -90 to 90")
        require(0 <= self.half_width_deg <= 180, "half_width_deg", self.half_width_deg, "0 to 180")

    def sample_direction(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a unit direction [3], uniform by solid angle."""
        low, high = (math.sin(math.radians(angle)) for angle in self.elevation_deg)
        z = rng.uniform(low, high)
        azimuth_offset_deg = rng.uniform(-self.half_width_deg, self.half_width_deg)
        azimuth = math.radians(self.azimuth_deg + azimuth_offset_deg)
        across = math.sqrt(1 - z * z)
        return np.array([across * math.cos(azimuth), across * math.sin(azimuth), z])


@checked("scene settings")
class CameraSettings:
    """Ranges from which cameras are drawn, as published."""

    distance: Annotated[Range, SIZE] = (1.5, 2.0)
    """Distance from the camera to the point it looks at, in world units."""
    target_jitter: Annotated[float, OFFSET] = 0.2
    """Maximum offset per axis from the origin of the point that a camera looks at."""
    up_jitter: Annotated[float, Within(0, 1)] = 0.1
    """Maximum offset per axis of a camera's up vector from +Z."""
    fov_deg: Annotated[Range, Within(1, 170, unit="degrees")] = (30.0, 60.0)
    """Full field of view, horizontal and vertical."""


def sample_camera(rng: np.random.Generator, settings: CameraSettings, sector: Sector) -> CameraPose:
    """Draw one camera pose by look-at. Whether it sees anything is for the caller to find out."""
    target = rng.uniform(-settings.target_jitter, settings.target_jitter, size=3)
    eye = target + rng.uniform(*settings.distance) * sector.sample_direction(rng)
    up = np.array([0, 0, 1]) + rng.uniform(-settings.up_jitter, settings.up_jitter, size=3)
    return CameraPose(
        c2w=look_at_c2w(eye=eye, target=target, up=up),
        fov_deg=float(rng.uniform(*settings.fov_deg)),
    )
