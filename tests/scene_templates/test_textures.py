"""Which surfaces are textured, and how their textures lie: the stated distributions."""

import dataclasses

import numpy as np

from scene_templates.surfaces.draw import SurfaceMapSettings
from scene_templates.textures import TexturedLook, TextureSettings, draw_look
from storage.seeds import rng_for
from tests.scene_templates.statistics import choices, require_plausible, share, uniform

SETTINGS = TextureSettings(
    share=0.4, surfaces=SurfaceMapSettings(families=("checker", "stripes"), size=8)
)


def _looks(settings: TextureSettings, count: int) -> list[TexturedLook | None]:
    return [draw_look(rng_for(0, "texture", number), settings) for number in range(count)]


def test_looks_are_drawn_as_stated() -> None:
    drawn = _looks(SETTINGS, 2000)
    looks = [look for look in drawn if look is not None]
    require_plausible(
        {
            "share": share([look is not None for look in drawn], 0.4),
            "families": choices(
                [look.maps.family for look in looks], {"checker": 1.0, "stripes": 1.0}
            ),
            "width": uniform([look.tile_m for look in looks], *SETTINGS.tile_m),
            "turns": choices([look.quarter_turns for look in looks], dict.fromkeys(range(4), 1.0)),
            "shift along u": uniform([look.shift_uv[0] for look in looks], 0, 1),
            "shift along v": uniform([look.shift_uv[1] for look in looks], 0, 1),
        }
    )


def test_another_share_changes_no_texture_that_is_there_still() -> None:
    few, all_ = _looks(SETTINGS, 40), _looks(dataclasses.replace(SETTINGS, share=1.0), 40)
    for one, other in zip(few, all_, strict=True):
        assert other is not None
        if one is not None:
            assert one.tile_m == other.tile_m
            assert np.array_equal(one.maps.diffuse_rgb, other.maps.diffuse_rgb)


def test_a_quarter_turn_turns_the_picture_counter_clockwise() -> None:
    look = draw_look(rng_for(1, "texture"), dataclasses.replace(SETTINGS, share=1.0))
    assert look is not None
    turned = dataclasses.replace(look, quarter_turns=1, tile_m=2.0, shift_uv=(0.0, 0.0))
    # What lay to the right (+x) now lies above (+y): u grows with y, and v against x.
    assert np.allclose(turned.uv(np.array([[0.0, 1.0], [1.0, 0.0]])), [[0.5, 0], [0, -0.5]])
