"""A scene's kind is decided before anything is tried, and turns are whole."""

import dataclasses
from collections import Counter

import pytest

from pipeline.builds.named import named_build
from scene_templates.frozen_v1 import ONE_FAMILY_EACH
from scene_templates.layout_rand import scene_plan
from scene_templates.settings import SceneSettings
from tests.scene_templates.balls import DEFAULTS


def test_a_plan_depends_on_seed_and_index_alone() -> None:
    one = [scene_plan(DEFAULTS, seed=0, scene_index=index) for index in range(40)]
    again = [scene_plan(DEFAULTS, seed=0, scene_index=index) for index in reversed(range(40))]
    assert one == again[::-1]
    other = [scene_plan(DEFAULTS, seed=1, scene_index=index) for index in range(40)]
    assert sum(a == b for a, b in zip(one, other, strict=True)) < 10
    # What is not of the plan does not move it.
    finer = dataclasses.replace(DEFAULTS, max_triangles=4096, num_views=1, enough_error=0.0)
    assert [scene_plan(finer, seed=0, scene_index=index) for index in range(40)] == one


def test_families_in_turn_have_exactly_their_share() -> None:
    settings = SceneSettings(families=ONE_FAMILY_EACH, families_in_turn=True)
    names = [scene_plan(settings, seed=5, scene_index=i).family.name for i in range(200)]
    assert names[:4] == ["plane", "wall", "corner", "open_box"]
    assert set(Counter(names).values()) == {50}
    drawn = dataclasses.replace(settings, families_in_turn=False)
    names = [scene_plan(drawn, seed=5, scene_index=i).family.name for i in range(200)]
    assert set(Counter(names).values()) != {50}


@pytest.mark.parametrize("turns", [1, 3])
def test_every_excursion_meets_every_family_equally_often(turns: int) -> None:
    """Were both to turn with the index, 37 and 4 would still meet; 36 and 4 would not."""
    settings = named_build("out-of-range").scenes
    for count in (37, 36):
        chosen = dataclasses.replace(settings, excursions=settings.excursions[:count])
        found = Counter(
            (chosen.excursion_of(i), scene_plan(chosen, seed=0, scene_index=i).family.name)
            for i in range(4 * count * turns)
        )
        assert len(found) == 4 * count
        assert set(found.values()) == {turns}


def test_weights_are_relative() -> None:
    """A family of almost no weight hardly ever comes, and one of all the weight always does."""
    heavy, *light = (
        dataclasses.replace(family, weight=1e9 if row == 0 else 1e-9)
        for row, family in enumerate(ONE_FAMILY_EACH)
    )
    settings = SceneSettings(families=(*light, heavy))
    names = {scene_plan(settings, seed=0, scene_index=i).family.name for i in range(200)}
    assert names == {heavy.name}
