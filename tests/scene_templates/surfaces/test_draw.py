"""`draw_surface`: which families, which sizes, and what is refused."""

from typing import Any

import numpy as np
import pytest

from scene_templates.surfaces.draw import SurfaceMapSettings, draw_surface
from scene_templates.surfaces.families import OUR_SURFACES, SURFACES
from storage.errors import TrilightError
from storage.seeds import rng_for
from storage.settings.described import described
from tests.for_each import for_each
from tests.scene_templates.statistics import choices, require_plausible, share


def test_families_are_equally_likely_and_natural_as_often_as_stated() -> None:
    settings = SurfaceMapSettings(size=1, natural_share=0.4)
    found = [draw_surface(rng_for(seed, "surface"), settings) for seed in range(400)]
    natural = [maps.parameters["natural colours"] == (True,) for maps in found]
    families = [maps.family for maps in found]
    require_plausible(
        {
            "families": choices(families, dict.fromkeys(OUR_SURFACES, 1.0)),
            "natural": share(natural, 0.4),
        }
    )


def test_all_of_ours_are_drawn_by_default() -> None:
    assert SurfaceMapSettings().families == OUR_SURFACES == tuple(SURFACES)
    assert len(OUR_SURFACES) >= 10


def test_colours_that_are_not_natural_are_in_the_stated_range() -> None:
    settings = SurfaceMapSettings(
        families=("checker",), size=64, natural_share=0.0, albedo=(0.4, 0.4)
    )
    maps = draw_surface(rng_for(0, "surface"), settings)
    assert "light square: any colour" in maps.parameters
    # diffuse = (1 - share) x base: the same in every channel, as the base colour is
    assert np.ptp(maps.diffuse_rgb, axis=-1).max() == 0


@for_each(
    ("name", "value"),
    [
        ("families", ()),
        ("families", ("gold",)),
        ("size", 0),
        ("size", 100),
        ("size", 4096),
        ("size", 64.0),
        ("natural_share", 1.1),
        ("albedo", (0.5, 0.1)),
        ("albedo", (0.0, 1.0)),
        ("roughness_clip", (0.0, 1.5)),
    ],
)
def test_a_contradiction_is_one_line_that_names_its_field(name: str, value: Any) -> None:
    with pytest.raises(TrilightError) as caught:
        SurfaceMapSettings(**{name: value})
    message = str(caught.value)
    assert "\n" not in message
    assert name in message or "'gold' is unknown" in message


def test_every_setting_has_a_sentence() -> None:
    for field in described(SurfaceMapSettings):
        assert field.sentence.endswith(".")
        assert field.expected
