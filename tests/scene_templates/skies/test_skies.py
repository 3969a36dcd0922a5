"""Skies: texels of the sphere, colours of black bodies, and which scenes have which."""

import dataclasses
import math

import numpy as np
import pytest

from pipeline.presets.registry import preset_settings
from scene_templates.skies.drawn_scene import SceneSky, lamp_irradiance, scene_sky
from scene_templates.skies.procedural_skies import (
    OUR_SKIES,
    SKIES,
    SkyMapSettings,
    SkySettings,
    draw_sky,
    planckian_rgb,
)
from scene_templates.skies.texels import SkyTexels
from storage.records.scene import Scene
from storage.seeds import SceneKey, rng_for
from tests.for_each import for_each
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scene_templates.drawn_values import with_draws
from tests.scene_templates.statistics import choices, require_plausible, share, uniform


def uv_of(direction: np.ndarray) -> tuple[float, float]:
    """Return where a map shows a direction: the convention, in other words than the product's."""
    x, y, z = direction
    return 0.5 - math.atan2(y, x) / (2 * math.pi), 0.5 + math.asin(z) / math.pi


def _unit(seed: int) -> np.ndarray:
    vector = rng_for(seed, "direction").standard_normal(3)
    return vector / np.sqrt(np.square(vector).sum())


def test_texel_centres_are_where_the_convention_shows_them() -> None:
    height = 16
    directions = SkyTexels(height).directions
    np.testing.assert_allclose(np.square(directions).sum(axis=-1), 1, atol=1e-14)
    for row in range(height):
        for column in range(2 * height):
            u, v = uv_of(directions[row, column])
            assert u * 2 * height == pytest.approx(column + 0.5, abs=1e-9)
            assert (1 - v) * height == pytest.approx(row + 0.5, abs=1e-9)


@for_each("height", [1, 2, 7, 64])
def test_solid_angles_sum_to_the_sphere(height: int) -> None:
    texels = SkyTexels(height)
    ones = np.ones((height, 2 * height))
    assert float(texels.flux(ones)) == pytest.approx(4 * math.pi, rel=1e-13)
    assert texels.solid_angle.shape == (height, 1) and (texels.solid_angle > 0).all()


def test_a_sky_cannot_write_into_the_arrays_of_the_next_one() -> None:
    texels = SkyTexels(4)
    shared = (texels.directions, texels.z, texels.solid_angle)
    assert not any(array.flags.writeable for array in shared)


def test_a_white_sky_sends_pi_onto_the_ground() -> None:
    found = SkyTexels(64).irradiance(np.ones((64, 128, 3)))
    # the midpoint rule on 64 rows errs by (pi / 64)^2 / 6
    np.testing.assert_allclose(found, math.pi, rtol=5e-4)


@for_each("height", [1, 2, 8, 33, 64, 256])
def test_a_spot_has_unit_flux_and_is_where_it_should_be(height: int) -> None:
    texels = SkyTexels(height)
    for seed in range(12):
        towards = _unit(seed) if seed else np.array([0.0, 0.0, 1.0])
        spot = texels.spot(towards)
        assert (spot >= 0).all()
        assert float(texels.flux(spot)) == pytest.approx(1, rel=1e-13)
        brightest = np.unravel_index(np.argmax(spot), spot.shape)
        angle = math.acos(np.clip(texels.directions[brightest] @ towards, -1, 1))
        # the nearest centre: half a diagonal of a texel away at most
        assert angle <= math.sqrt(0.5) * math.pi / height + 1e-9
        if height >= 8:
            lit = (spot > 0) * texels.solid_angle
            # a cap of 1.5 rows, and texels whose centres are in it: a few
            assert lit.sum() < 2 * math.pi * (1.5 * math.pi / height) ** 2


@pytest.mark.parametrize("sharpness", [0.5, 4.0, 60.0])
def test_a_lobe_has_its_closed_form(sharpness: float) -> None:
    """The integral of (1 + k (1 - c))^-2 over the sphere is 4 pi / (1 + 2 k)."""
    texels, towards = SkyTexels(128), _unit(1)
    found = texels.lobe(towards, sharpness)
    below = 1 + sharpness * (1 - texels.directions @ towards)
    expected = (1 + 2 * sharpness) / (4 * math.pi) / np.square(below)
    # 128 rows integrate a lobe of 10 degrees to a thousandth
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_panes_have_the_solid_angle_of_rectangles_and_stand_upright() -> None:
    """4 asin(a b / sqrt((1 + a^2)(1 + b^2))), half of it below a bar of half its width."""
    texels = SkyTexels(256)
    for seed in range(3):
        towards, half = _unit(seed), (0.4, 0.25)
        expected = 4 * math.asin(
            half[0] * half[1] / math.sqrt((1 + half[0] ** 2) * (1 + half[1] ** 2))
        )
        found = float(texels.flux(texels.pane(towards, half, roll_rad=seed / 2)))
        # edges are ramps of about a texel whose width grows off the middle
        assert found == pytest.approx(expected, rel=0.03)
        barred = texels.pane(towards, half, panes=(2, 2), bars=0.5)
        # of each pane, a quarter is clear
        assert float(texels.flux(barred)) == pytest.approx(expected / 4, rel=0.08)
        assert (texels.pane(towards, half)[(texels.directions @ towards) < 0] == 0).all()
    pane = SkyTexels(64).pane(np.array([1.0, 0.0, 0.0]), (0.8, 0.2))
    rows, columns = np.nonzero(pane > 0.5)
    assert np.ptp(columns) > 2 * np.ptp(rows)
    texels, towards = SkyTexels(4), _unit(3)
    nothing = np.zeros((4, 8))
    np.testing.assert_array_equal(texels.of_unit_flux(nothing, towards), texels.spot(towards))


def test_noise_is_the_same_all_over_the_sphere() -> None:
    """Neither the seam at u = 0 nor the poles show: steps in space decide steps of the noise."""
    texels = SkyTexels(128)
    fields = np.stack([texels.noise(rng_for(seed, "noise"), 4.0) for seed in range(12)])
    seam = fields[:, :, 0] - fields[:, :, -1]
    inside = fields[:, :, 64] - fields[:, :, 63]
    # 12 x 25 independent cells along each line: a deviation to 1 / sqrt(600), and five times that
    assert seam.std() == pytest.approx(inside.std(), rel=0.25)
    # around a pole, texels lie closer and closer: so do their values
    around_pole = np.abs(np.diff(fields[:, 0], axis=1)).max()
    assert around_pole < 0.1 * np.abs(np.diff(fields[:, 64], axis=1)).max()
    assert 0.3 < fields.std() < 0.5
    weight = np.broadcast_to(texels.solid_angle, (128, 256))
    rows = [np.sqrt(np.average(np.square(fields[:, part]), weights=np.stack([weight[part]] * 12)))
            for part in (slice(0, 32), slice(48, 80), slice(96, 128))]  # fmt: skip
    assert max(rows) < 1.4 * min(rows), "poles and equator have one deviation"


def test_octaves_that_texels_cannot_show_are_left_out() -> None:
    texels = SkyTexels(64)  # cells of up to 64 / 4 pi = 5.1 a radius
    few = texels.noise(rng_for(0, "noise"), 2.0, octaves=2)
    np.testing.assert_array_equal(few, texels.noise(rng_for(0, "noise"), 2.0, octaves=9))
    assert np.abs(few - texels.noise(rng_for(0, "noise"), 2.0)).max() > 0.01


WAVELENGTHS_NM = np.arange(380.0, 781.0)
_XYZ_TO_REC709 = np.linalg.inv(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip


def _lobes(*rows: tuple[float, float, float, float]) -> np.ndarray:
    total = np.zeros_like(WAVELENGTHS_NM)
    for height, middle, below, above in rows:
        width = np.where(WAVELENGTHS_NM < middle, below, above)
        total += height * np.exp(-0.5 * np.square((WAVELENGTHS_NM - middle) / width))
    return total


OBSERVER = np.stack(
    [
        _lobes((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
        _lobes((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
        _lobes((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
    ]
)
"""The fit of Wyman et al. (2013), table 1."""


@for_each("mired", [40, 80, 153.8, 249, 251, 300, 400, 449, 451, 499])
def test_a_black_body_has_the_colour_of_plancks_law(mired: float) -> None:
    metres = WAVELENGTHS_NM * 1e-9
    spectrum = metres**-5 / np.expm1(0.014387769 / metres / (1e6 / mired))
    rgb = _XYZ_TO_REC709 @ (OBSERVER @ spectrum)
    # both fits are good to about 0.003 of a chromaticity, up to 2 % of a channel's mean of 1
    np.testing.assert_allclose(planckian_rgb(mired), rgb / rgb.mean(), atol=0.04)


def test_colours_are_positive_with_a_mean_of_1_and_no_jump() -> None:
    found = np.array([planckian_rgb(m) for m in np.linspace(40, 500, 2000)])
    assert (found >= 0).all()
    np.testing.assert_allclose(found.mean(axis=1), 1, rtol=1e-14)
    # 0.23 mired a step, where the steepest channel changes by 0.006 a mired; the pieces of the
    # fit meet within a thousandth
    assert np.abs(np.diff(found, axis=0)).max() < 0.01
    assert (np.diff(found[:, 0]) > -0.003).all(), "warmer is redder"


def test_ours_are_drawn_with_brightness_and_colours_as_stated() -> None:
    settings = SkyMapSettings(height=1, coloured_share=0.4, mean_radiance=(1.0, 3.0))
    found = [with_draws(draw_sky, rng_for(seed, "sky"), settings) for seed in range(400)]
    families = [family for (family, _), _ in found]
    coloured = [draws["coloured lights"] == (True,) for _, draws in found]
    require_plausible(
        {
            "families": choices(families, dict.fromkeys(OUR_SKIES, 1.0)),
            "coloured": share(coloured, 0.4),
            "mean": uniform([float(sky.mean()) for (_, sky), _ in found], 1.0, 3.0),
        }
    )
    assert SkyMapSettings().families == OUR_SKIES == tuple(SKIES)


SMALL = SkyMapSettings(height=8)
LAMP = np.array([[[0, 0, 2], [0.1, 0, 2], [0, 0.1, 2]]], np.float64)
RADIANCE = np.array([[300.0, 200.0, 100.0]])


def _drawn(settings: SkySettings, count: int = 2000) -> list[SceneSky | None]:
    return [scene_sky(settings, LAMP, RADIANCE, SceneKey(3, index)) for index in range(count)]


def test_shares_families_strengths_and_turns_are_as_stated() -> None:
    settings = SkySettings(share=0.4, over_lamps_log=(0.1, 10.0), seen_share=0.3, maps=SMALL)
    found = [sky for sky in _drawn(settings) if sky is not None]
    families = [sky.origin["family"] for sky in found]
    log = np.log10([sky.origin["over_lamps"] for sky in found])
    turns_deg = np.array([sky.origin["azimuth_deg"] for sky in found])
    assert abs(log).max() <= 1 and turns_deg.min() >= 0 and turns_deg.max() <= 360
    require_plausible(
        {
            "share": share(np.arange(2000) < len(found), 0.4),
            "seen": share([sky.environment.is_seen for sky in found], 0.3),
            "families": choices(families, dict.fromkeys(OUR_SKIES, 1.0)),
            "over lamps": uniform(log, -1, 1),
            "turns": uniform(turns_deg, 0, 360),
        }
    )


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
    """Objects, materials, lights and cameras are those of the preset without skies."""
    plain = preset_settings("pretrain-256").scenes
    skies = preset_settings("sky-256").scenes
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
