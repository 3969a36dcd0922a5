"""Samples cameras, which look near the origin from a sector of directions: a layout's open side."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import OFFSET, SIZE, Range, require
from storage.conventions import look_at_c2w
from storage.settings.described import checked, leaves_out
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
        expected = "two from -90 to 90, the lower number first"
        require(-90 <= low <= high <= 90, "elevation_deg", (low, high), expected)
        require(0 <= self.half_width_deg <= 180, "half_width_deg", self.half_width_deg, "0 to 180")

    def sample_direction(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a unit direction [3], uniform by solid angle."""
        low, high = (math.sin(math.radians(angle)) for angle in self.elevation_deg)
        z = rng.uniform(low, high)
        return self._direction(z, rng.uniform(-self.half_width_deg, self.half_width_deg))

    def direction_at(self, across: float, up: float) -> NDArray[np.float64]:
        """Return the unit direction [3] of a position; equal areas of both are equal solid angles.

        Args:
            across: 0 to 1, from one side of the azimuth to the other.
            up: 0 to 1, from the least elevation to the greatest.
        """
        low, high = (math.sin(math.radians(angle)) for angle in self.elevation_deg)
        return self._direction(low + (high - low) * up, (2 * across - 1) * self.half_width_deg)

    def _direction(self, z: float, azimuth_offset_deg: float) -> NDArray[np.float64]:
        azimuth = math.radians(self.azimuth_deg + azimuth_offset_deg)
        across = math.sqrt(1 - z * z)
        return np.array([across * math.cos(azimuth), across * math.sin(azimuth), z])


CameraPath = Literal["random", "sphere", "fibonacci", "orbit"]
"""How the views of a scene are spread over its sector of directions.

`random`: each by itself, uniform by solid angle. `sphere`: Hammersley points. `fibonacci`: a spiral
of golden angles. `orbit`: equal steps of azimuth at one elevation, which is drawn for the scene.
"""

_GOLDEN = (math.sqrt(5) - 1) / 2


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
    path: CameraPath = "random"
    """Directions of a scene's views: `random` (each by itself), `sphere` (Hammersley points),
    `fibonacci` (a spiral) or `orbit` (a circle at one elevation). A view of a path that is rejected
    is replaced by a random one."""
    elevation_deg: Annotated[Range | None, Within(-89, 89, unit="degrees")] = None
    """Range of the cameras' elevations in place of that of the layout."""
    _record = leaves_out("path", "elevation_deg")


def path_position(
    path: CameraPath, view: int, num_views: int, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return the position of a view on a path (`Sector.direction_at`); None for `random`.

    Args:
        path: the path.
        view: number of the view, from 0.
        num_views: number of the scene's views.
        rng: of the scene, the same for all of its views: it turns the path.
    """
    azimuth_shift, height = rng.random(2).tolist()
    up = (view + 0.5) / num_views
    if path == "sphere":
        return (_radical_inverse(view) + azimuth_shift) % 1, up
    if path == "fibonacci":
        return (view * _GOLDEN + azimuth_shift) % 1, up
    return ((view + azimuth_shift) / num_views, height) if path == "orbit" else None


def _radical_inverse(number: int) -> float:
    """Return the binary digits of a number mirrored at the point, in [0, 1)."""
    digits = f"{number:b}"
    return int(digits[::-1], 2) / 2 ** len(digits)


def sample_camera(
    rng: np.random.Generator,
    settings: CameraSettings,
    sector: Sector,
    position: tuple[float, float] | None = None,
) -> tuple[NDArray[np.float64], float]:
    """Draw one camera by look-at. Whether it sees anything is for the caller to find out.

    Args:
        rng: where the numbers come from.
        settings: the ranges.
        sector: directions from which the layout is seen.
        position: of the direction in the sector (`Sector.direction_at`); None to draw it.

    Returns:
        Camera to world [4, 4] (storage.conventions), and the full field of view in degrees.
    """
    if settings.elevation_deg is not None:
        sector = dataclasses.replace(sector, elevation_deg=settings.elevation_deg)
    target = rng.uniform(-settings.target_jitter, settings.target_jitter, size=3)
    distance = rng.uniform(*settings.distance)
    towards = sector.sample_direction(rng) if position is None else sector.direction_at(*position)
    eye = target + distance * towards
    up = np.array([0, 0, 1]) + rng.uniform(-settings.up_jitter, settings.up_jitter, size=3)
    return look_at_c2w(eye=eye, target=target, up=up), float(rng.uniform(*settings.fov_deg))
