"""`SkyDraws`: the draws of a sky, with lights of natural colours, as bodies glow, or of any."""

import numpy as np

from scene_templates.exact import Numbers
from scene_templates.recorded_sampler import RecordedSampler

PALEST = 0.1
"""Least channel of a coloured light before its mean is made 1: no light is quite monochrome."""


DEEP_BLUE = (0.3, 0.75, 1.95)
PALE_BLUE = (0.75, 0.97, 1.28)
"""Colours, of mean 1, of a clean and of a hazy sky: bluer than any black body is."""


WARMEST_MIRED = 500.0
COOLEST_MIRED = 40.0
"""2,000 and 25,000 kelvin: colours of the Planckian locus that Rec.709 can show, by its fit."""

_TO_REC709 = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def planckian_rgb(mired: float) -> Numbers:
    """Return the linear colour [3], of mean 1, of a black body.

    By the cubic fit of Kim et al. (2002) to the chromaticities, which is polynomials alone.

    Args:
        mired: a million over the temperature in kelvin: 500 is a candle, 154 daylight, 40 blue sky.
            Equal steps look equal, as equal steps in kelvin do not.
    """
    t = mired / 1000
    if mired > 250:  # below 4,000 K
        x = ((-0.2661239 * t - 0.2343589) * t + 0.8776956) * t + 0.179910
    else:
        x = ((-3.0258469 * t + 2.1070379) * t + 0.2226347) * t + 0.240390
    if mired > 450:
        y = ((-1.1063814 * x - 1.34811020) * x + 2.18555832) * x - 0.20219683
    elif mired > 250:
        y = ((-0.9549476 * x - 1.37418593) * x + 2.09137015) * x - 0.16748867
    else:
        y = ((3.0817580 * x - 5.87338670) * x + 3.75112997) * x - 0.37001483
    xyz = (x / y, 1.0, (1 - x - y) / y)
    linear = [row[0] * xyz[0] + row[1] * xyz[1] + row[2] * xyz[2] for row in _TO_REC709]
    rgb = np.array([max(0.0, channel) for channel in linear])
    result: Numbers = rgb / ((rgb[0] + rgb[1] + rgb[2]) / 3)
    return result


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
            mired: natural range of its colour (`planckian_rgb`), uniform in it.
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
