"""`SkyDraws`: the draws of a sky, with lights of natural colours or of any."""

import numpy as np

from scene_templates.exact import Numbers
from scene_templates.recorded_sampler import RecordedSampler
from scene_templates.skies.colour import planckian_rgb

PALEST = 0.1
"""Least channel of a coloured light before its mean is made 1: no light is quite monochrome."""


DEEP_BLUE = (0.3, 0.75, 1.95)
PALE_BLUE = (0.75, 0.97, 1.28)
"""Colours, of mean 1, of a clean and of a hazy sky: bluer than any black body is."""


class SkyDraws(RecordedSampler):
    """Draws by name, and colours of lights that follow the sky's own choice."""

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        coloured_share: float,
        sun_elevation_deg: tuple[float, float] = (2.0, 75.0),
        sun_to_sky: tuple[float, float] = (0.5, 8.0),
    ) -> None:
        """Begin a sky.

        Args:
            rng: where the numbers come from.
            coloured_share: probability of lights of any colour, for all lights of the sky.
            sun_elevation_deg: range of the sun's elevation.
            sun_to_sky: range of the sun's irradiance over the sky's.
        """
        super().__init__(rng)
        self._coloured = self.holds("coloured lights", coloured_share)
        self.sun_elevation_deg = sun_elevation_deg
        self.sun_to_sky = sun_to_sky

    def light(self, name: str, *, mired: tuple[float, float]) -> Numbers:
        """Return the colour [3], of mean 1, of a light.

        Args:
            name: of the light.
            mired: natural range of its colour (scene_templates.skies.colour), uniform in it.
        """
        if not self._coloured:
            return planckian_rgb(self.uniform(f"{name}: mired", *mired))
        return self._any_colour(name)

    def blue(self, name: str) -> Numbers:
        """Return the colour [3], of mean 1, of a sky that is blue where lights are natural."""
        if not self._coloured:
            return self.shade(f"{name}: colour", DEEP_BLUE, PALE_BLUE)
        return self._any_colour(name)

    def _any_colour(self, name: str) -> Numbers:
        rgb = self.colour(f"{name}: any colour", (PALEST,) * 3, (1.0,) * 3)
        result: Numbers = rgb / ((rgb[0] + rgb[1] + rgb[2]) / 3)
        return result
