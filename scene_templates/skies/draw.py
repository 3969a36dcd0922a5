"""`draw_sky`: a procedural environment map, the light from all around a scene."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from scene_templates.checks import Range, require
from scene_templates.skies.draws import SkyDraws
from scene_templates.skies.procedural_skies import OUR_SKIES, SKIES
from scene_templates.skies.texels import SkyTexels
from storage.settings.described import checked
from storage.settings.ranges import Share, Within


@dataclass(frozen=True, kw_only=True, eq=False)
class SkyMap:
    """A latitude-longitude map of linear radiance; scene_templates.skies.texels orients it."""

    family: str
    """Name of the family that it was drawn from."""
    radiance_rgb: NDArray[np.float32]
    """[H, 2H, 3], the top row first, the middle of the picture +X, a quarter from the left +Y."""
    parameters: Mapping[str, tuple[Any, ...]]
    """Drawn values; the names are those of the reference page of surfaces and skies."""


@checked("sky settings")
class SkyMapSettings:
    """What procedural skies are drawn from."""

    families: tuple[str, ...] = OUR_SKIES
    """Families of skies, each equally likely; a name that stands twice is twice as likely."""
    height: Annotated[int, Within(1, 1024, unit="rows")] = 256
    """Rows of a map, which has twice as many columns. The same seed gives the same sky at every
    height, and the same irradiance of its sun."""
    mean_radiance: Annotated[Range, Within(0, 1e9)] = (0.2, 2.0)
    """Range of the mean radiance over the sphere and the three channels. A white Lambert floor
    under a constant sky has the radiance of the sky."""
    coloured_share: Share = 0.1
    """Share of the skies whose lights have any color; in the others, they are black bodies."""
    sun_elevation_deg: Annotated[Range, Within(-90, 90, unit="degrees")] = (2.0, 75.0)
    """Range of the elevation of a sun, uniform by solid angle."""
    sun_to_sky: Annotated[Range, Within(0, 1e9)] = (0.5, 8.0)
    """Range of the irradiance of a sun, on a plane that faces it, over the irradiance of the rest
    of the upper half of the sky on a horizontal plane."""

    def __post_init__(self) -> None:
        require(len(self.families) > 0, "families", self.families, "at least one")
        for name in self.families:
            SKIES.find(name)


def draw_sky(rng: np.random.Generator, settings: SkyMapSettings) -> SkyMap:
    """Draw a sky of one of the families.

    Equal generators and settings give equal bytes on every processor with IEEE arithmetic
    (scene_templates.exact). A sky of 256 rows takes 0.03 to 0.5 core-seconds.

    Args:
        rng: such as `rng_for(seed, "sky", number)`.
        settings: the ranges.
    """
    name = settings.families[int(rng.integers(len(settings.families)))]
    texels = SkyTexels(settings.height)
    draws = SkyDraws(
        rng,
        coloured_share=settings.coloured_share,
        sun_elevation_deg=settings.sun_elevation_deg,
        sun_to_sky=settings.sun_to_sky,
    )
    mean = draws.uniform("mean radiance", *settings.mean_radiance)
    shape = SKIES[name](draws, texels)
    red, green, blue = texels.flux(shape)
    scale = mean * 4 * np.pi * 3 / float(red + green + blue)
    return SkyMap(
        family=name,
        radiance_rgb=(shape * scale).astype(np.float32),
        parameters=draws.parameters(),
    )
