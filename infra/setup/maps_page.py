"""Writes docs/reference/surfaces-and-skies.md: what every surface and sky is drawn from."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from pipeline.documents.markdown import table
from scene_templates.skies.draw import SkyMapSettings
from scene_templates.skies.draws import PALEST, SkyDraws
from scene_templates.skies.families import OUR_SKIES, SKIES
from scene_templates.skies.texels import SkyTexels
from scene_templates.stated_draws import StatedDraw
from scene_templates.surfaces.draw import SurfaceMapSettings
from scene_templates.surfaces.draws import LEAST_TINT, SurfaceDraws
from scene_templates.surfaces.families import OUR_SURFACES, SURFACES
from scene_templates.surfaces.texels import Texels
from storage.seeds import rng_for

FILE = Path(__file__).parents[2] / "docs/reference/surfaces-and-skies.md"

_HEAD = """# Surfaces and skies: what they are drawn from

Made by `make settings` from the draws themselves: `scene_templates/surfaces` and
`scene_templates/skies` state each range where they draw from it, and tests compare what comes out
with it. [Surfaces and skies](../explanation/surfaces-and-skies.md) says how they are made. Colours
are linear, with Rec.709 primaries.

The tables are those of natural colours (`SurfaceMapSettings.natural_share`,
`SkyMapSettings.coloured_share`). A natural base colour is the stated one times a tint, whose
channels are uniform from {least_tint:g} to 1. In the other surfaces, each channel of each base
colour is uniform in `SurfaceMapSettings.albedo`. Natural lights are black bodies; a mired is a
million over the temperature in kelvin. In the other skies, each channel of each light is uniform
from {palest:g} to 1, and the colour is then scaled to a mean of 1. What is drawn several times,
such as the power of each lamp, stands once.
"""

_SEEDS = 32
"""Draws of each family, so that what it draws only sometimes is seen too."""


def main() -> None:
    """Write the file."""
    FILE.write_text(maps_page())


def maps_page() -> str:
    """Return docs/reference/surfaces-and-skies.md."""
    parts = [_HEAD.format(least_tint=LEAST_TINT, palest=PALEST), "## Surfaces\n"]
    for name in OUR_SURFACES:
        parts += _family(name, SURFACES[name], surface_draws(name))
    parts.append("## Skies\n")
    for name in OUR_SKIES:
        parts += _family(name, SKIES[name], sky_draws(name))
    return "\n".join(parts)


def surface_draws(name: str) -> Mapping[str, StatedDraw]:
    """Return all that a family of surfaces draws by name, in natural colours."""
    made: dict[str, StatedDraw] = {}
    albedo = SurfaceMapSettings().albedo
    for seed in range(_SEEDS):
        draws = SurfaceDraws(rng_for(seed, "page"), natural_share=1.0, albedo=albedo)
        SURFACES[name](draws, Texels(1))
        made |= draws.made
    return _but(made, "natural colours", ": tint")


def sky_draws(name: str) -> Mapping[str, StatedDraw]:
    """Return all that a family of skies draws by name, in natural colours."""
    made: dict[str, StatedDraw] = {}
    settings = SkyMapSettings()
    for seed in range(_SEEDS):
        draws = SkyDraws(
            rng_for(seed, "page"),
            coloured_share=0.0,
            sun_elevation_deg=settings.sun_elevation_deg,
            sun_to_sky=settings.sun_to_sky,
        )
        SKIES[name](draws, SkyTexels(1))
        made |= draws.made
    return _but(made, "coloured lights")


def _but(made: Mapping[str, StatedDraw], *said_above: str) -> dict[str, StatedDraw]:
    return {label: draw for label, draw in made.items() if not label.endswith(said_above)}


def _family(
    name: str, family: Callable[..., object], made: Mapping[str, StatedDraw]
) -> Iterator[str]:
    yield f"### `{name}`\n\n{' '.join((inspect.getdoc(family) or '').split())}\n"
    yield table(("drawn", "distribution"), [(label, str(draw)) for label, draw in made.items()])
    yield ""


if __name__ == "__main__":
    main()
