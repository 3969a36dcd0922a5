"""`draw_surface`: a procedural texture from a generator."""

from typing import Annotated

import numpy as np

from scene_templates.checks import Range, require
from scene_templates.surfaces.draws import SurfaceDraws
from scene_templates.surfaces.maps import MOST_ALBEDO, SurfaceMaps, surface_maps
from scene_templates.surfaces.procedural_textures import OUR_SURFACES, SURFACES
from scene_templates.surfaces.texels import Texels
from storage.settings.described import checked
from storage.settings.ranges import Share, Within


@checked("surface settings")
class SurfaceMapSettings:
    """What procedural surfaces are drawn from."""

    families: tuple[str, ...] = OUR_SURFACES
    """Families of surfaces, each equally likely; a name that stands twice is twice as likely."""
    size: Annotated[int, Within(1, 2048, unit="texels")] = 256
    """Width and height of a map, a power of two. The same seed gives the same surface at every
    size; below 64 the finest pattern is a blur."""
    natural_share: Share = 0.7
    """Share of the surfaces with the colors of their family; in the others, each channel of each
    base color is uniform in `albedo`."""
    albedo: Annotated[Range, Within(0, MOST_ALBEDO)] = (0.02, 0.9)
    """Range of each channel of a base color that is not natural."""
    roughness_clip: Annotated[Range, Within(0, 1)] = (0.01, 1.0)
    """Minimum and maximum roughness, as of constant materials."""

    def __post_init__(self) -> None:
        require(len(self.families) > 0, "families", self.families, "at least one")
        for name in self.families:
            SURFACES.find(name)
        require(self.size & (self.size - 1) == 0, "size", self.size, "a power of two")


def draw_surface(rng: np.random.Generator, settings: SurfaceMapSettings) -> SurfaceMaps:
    """Draw a surface of one of the families.

    Equal generators and settings give equal bytes on every processor with IEEE arithmetic: maps are
    made of + - * /, square roots and comparisons of float64, and rounded to float32 once.

    A map of 256 x 256 texels takes 0.005 to 0.15 core-seconds.

    Args:
        rng: such as `rng_for(seed, "surface", number)`. What is drawn of it does not depend on the
            size.
        settings: the ranges.

    Returns:
        float32 maps [N, N, 3], [N, N, 3] and [N, N, 1] that repeat in both directions.
    """
    name = settings.families[int(rng.integers(len(settings.families)))]
    draws = SurfaceDraws(rng, natural_share=settings.natural_share, albedo=settings.albedo)
    made_of = SURFACES[name](draws, Texels(settings.size))
    return surface_maps(
        name,
        made_of,
        size=settings.size,
        roughness_clip=settings.roughness_clip,
        parameters=draws.parameters(),
    )
