"""Sectors of the sphere of directions: from where a layout may be seen and lit."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Sector:
    """Directions between two elevations and within an angle of one azimuth."""

    azimuth_deg: float
    """Middle of the sector; 0 is +X, 90 is +Y."""
    half_width_deg: float
    """Most angle to either side of it; 180 is all around."""
    elevation_deg: tuple[float, float]
    """Least and greatest angle above the horizon."""

    def direction_rand(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a unit direction [3], uniform by solid angle."""
        low, high = (math.sin(math.radians(angle)) for angle in self.elevation_deg)
        z = rng.uniform(low, high)
        turn = rng.uniform(-self.half_width_deg, self.half_width_deg)
        azimuth = math.radians(self.azimuth_deg + turn)
        across = math.sqrt(1 - z * z)
        return np.array([across * math.cos(azimuth), across * math.sin(azimuth), z])
