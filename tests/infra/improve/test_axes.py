"""Strata of a build: what each draws, and how often."""

import pytest

from infra.improve.axes import AXES, halves_of, strata_of
from pipeline.builds.named import named_build
from scene_templates.layout_rand import scene_plan
from storage.errors import TrilightError
from storage.settings.changes import changed
from storage.settings.described import settings_record

SCENES = named_build("smoke").scenes


def test_all_combinations_together_are_the_build() -> None:
    strata = strata_of(SCENES, tuple(AXES))
    assert len(strata) == 16 == len({stratum.name for stratum in strata})
    assert sum(stratum.weight for stratum in strata) == pytest.approx(1)
    many = sum(stratum.weight for stratum in strata if "many_objects" in halves_of(stratum.name))
    assert many == pytest.approx(2 / 3), "as the families' weights say"


def test_scenes_are_of_their_strata() -> None:
    strata = strata_of(SCENES, ("walls", "objects", "lights", "roughness"))
    record = [settings_record(stratum) for stratum in strata]
    scenes = changed(SCENES, {"strata": record})
    seen = set()
    for index in range(64):
        stratum = scenes.stratum_of(index)
        assert stratum is not None
        walls, objects, lights, roughness = halves_of(stratum.name)
        plan, of_scene = scene_plan(scenes, seed=3, scene_index=index), scenes.of_scene(index)
        assert (plan.num_lights > 4) == (lights == "many_lights")
        assert (plan.family.template in ("corner", "open_box")) == (walls == "many_walls")
        assert (plan.num_objects > 1) == (objects == "many_objects")
        low, high = of_scene.materials.roughness_log
        assert (low, high)[roughness == "glossy"] == pytest.approx(0.2516, abs=1e-4)
        seen.add(stratum.name)
    assert len(seen) == 16


def test_axes_that_cannot_be_are_refused() -> None:
    one_light = changed(SCENES, {"lights.count": [2, 2]})
    with pytest.raises(TrilightError, match="axis lights cannot be halved"):
        strata_of(one_light, ("lights",))
    with pytest.raises(TrilightError, match="expected each once"):
        strata_of(SCENES, ("lights", "lights"))
    with pytest.raises(TrilightError, match="strata of its own"):
        own = [settings_record(stratum) for stratum in strata_of(SCENES, ("lights",))]
        strata_of(changed(SCENES, {"strata": own}), ("walls",))
