"""Which scenes have skies, and how strong: the stated distribution, and what stays as it was."""

import dataclasses

import numpy as np
import pytest

from pipeline.builds.named import named_build
from scene_templates.skies.draw import SkyMapSettings
from scene_templates.skies.drawn_scene import SceneSky, lamp_irradiance, scene_sky
from scene_templates.skies.families import OUR_SKIES
from scene_templates.skies.settings import SkySettings
from storage.records.scene import Scene
from tests.pipeline.scenes.small_pool import first_scene, small_pool

SMALL = SkyMapSettings(height=8)
LAMP = np.array([[[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]]], np.float64)
RADIANCE = np.array([[300.0, 200.0, 100.0]])


def _drawn(settings: SkySettings, count: int = 2000) -> list[SceneSky | None]:
    return [
        scene_sky(settings, LAMP, RADIANCE, seed=3, scene_index=index, attempt=0)
        for index in range(count)
    ]


def test_shares_families_strengths_and_turns_are_as_stated() -> None:
    settings = SkySettings(share=0.4, over_lamps_log=(0.1, 10.0), seen_share=0.3, maps=SMALL)
    found = [sky for sky in _drawn(settings) if sky is not None]
    # Five standard deviations of a binomial draw of 2000, and of about 800.
    assert abs(len(found) / 2000 - 0.4) < 5 * np.sqrt(0.24 / 2000)
    seen = np.mean([sky.environment.is_seen for sky in found])
    assert abs(seen - 0.3) < 5 * np.sqrt(0.21 / len(found))
    families = [sky.origin["family"] for sky in found]
    for name in OUR_SKIES:
        assert abs(families.count(name) / len(found) - 1 / 8) < 5 * np.sqrt(7 / 64 / len(found))
    log = np.log10([sky.origin["over_lamps"] for sky in found])
    turns = np.array([sky.origin["azimuth_deg"] for sky in found]) / 360
    for values in ((log + 1) / 2, turns):
        assert values.min() >= 0 and values.max() <= 1
        # Kolmogorov's distance beyond which one uniform sample in a million lies.
        steps = np.arange(len(values)) / len(values)
        assert np.abs(np.sort(values) - steps).max() < 2.7 / np.sqrt(len(values))


def test_a_sky_sends_what_was_drawn_over_what_lamps_send() -> None:
    """Area x radiance / distance^2 of the lamp, against pi x the mean radiance of the map."""
    at = LAMP.mean(axis=1)[0]
    lamps = 0.005 * 200 / (at @ at)
    assert lamp_irradiance(LAMP, RADIANCE) == pytest.approx(lamps)
    for sky in _drawn(SkySettings(share=1.0, maps=SMALL), 20):
        assert sky is not None
        grey = sky.environment.radiance_rgb.astype(np.float64).mean(axis=(1, 2))
        weight = np.diff(np.sin(np.linspace(-np.pi / 2, np.pi / 2, 9)))[::-1] / 2
        # Float32 texels.
        assert np.pi * (grey @ weight) == pytest.approx(sky.origin["over_lamps"] * lamps, rel=1e-5)
        sky.environment.check()
        assert sky.environment.rotation[2].tolist() == [0, 0, 1]


def test_only_the_sky_is_new() -> None:
    """Objects, materials, lights and cameras are those of the build without skies."""
    plain = named_build("pretrain-256").scenes
    skies = named_build("sky-256").scenes
    assert dataclasses.replace(skies, skies=SkySettings()) == plain
    always = dataclasses.replace(
        skies, skies=dataclasses.replace(skies.skies, share=1.0, maps=SMALL)
    )
    before, after = (
        first_scene(settings, small_pool(), seed=1, scene_index=2) for settings in (plain, always)
    )
    assert before.environment is None and after.environment is not None
    assert after.provenance["sky"]["family"] == after.environment.source.name
    rest = {key: value for key, value in after.provenance.items() if key != "sky"}
    assert rest == before.provenance
    for field in dataclasses.fields(Scene):
        if field.name not in ("environment", "provenance", "objects"):
            np.testing.assert_array_equal(getattr(before, field.name), getattr(after, field.name))


def test_settings_without_skies_are_recorded_as_before() -> None:
    records = [named_build(name).as_json()["scenes"] for name in ("pretrain-256", "sky-256")]
    assert "skies" not in records[0] and records[1]["skies"]["share"] == 0.75
