"""`draw_sky`: which families, how bright, and what is refused."""

from typing import Any

import pytest

from scene_templates.skies.draw import SkyMapSettings, draw_sky
from scene_templates.skies.families import OUR_SKIES, SKIES
from storage.errors import TrilightError
from storage.seeds import rng_for
from storage.settings.described import described
from tests.for_each import for_each
from tests.scene_templates.statistics import choices, require_plausible, share, uniform


def test_families_brightness_and_colours_are_as_stated() -> None:
    settings = SkyMapSettings(height=1, coloured_share=0.4, mean_radiance=(1.0, 3.0))
    found = [draw_sky(rng_for(seed, "sky"), settings) for seed in range(400)]
    coloured = [sky.parameters["coloured lights"] == (True,) for sky in found]
    require_plausible(
        {
            "families": choices([sky.family for sky in found], dict.fromkeys(OUR_SKIES, 1.0)),
            "coloured": share(coloured, 0.4),
            "mean": uniform([float(sky.radiance_rgb.mean()) for sky in found], 1.0, 3.0),
        }
    )


def test_all_of_ours_are_drawn_by_default() -> None:
    assert SkyMapSettings().families == OUR_SKIES == tuple(SKIES)


@for_each(
    ("name", "value"),
    [
        ("families", ()),
        ("families", ("fog",)),
        ("height", 0),
        ("height", 2048),
        ("height", 8.5),
        ("mean_radiance", (-1.0, 1.0)),
        ("coloured_share", 2.0),
        ("sun_elevation_deg", (0.0, 91.0)),
        ("sun_to_sky", (2.0, 1.0)),
    ],
)
def test_a_contradiction_is_one_line_that_names_its_field(name: str, value: Any) -> None:
    with pytest.raises(TrilightError) as caught:
        SkyMapSettings(**{name: value})
    message = str(caught.value)
    assert "\n" not in message
    assert name in message or "'fog' is unknown" in message


def test_every_setting_has_a_sentence() -> None:
    for field in described(SkyMapSettings):
        assert field.sentence.endswith(".")
        assert field.expected
