"""Laws that every family of skies keeps: drawn as stated, lit as stated, seamless, reproducible.

Texels of the sphere, colours of black bodies, and which scenes have which sky.
"""

import dataclasses
import hashlib
import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.presets.registry import preset_settings
from scene_templates.scene_maps import lamp_irradiance, scene_sky
from scene_templates.skies.procedural_skies import (
    OUR_SKIES,
    SKIES,
    SkyDraws,
    SkyMapSettings,
    SkySettings,
    SkyTexels,
    draw_sky,
    planckian_rgb,
)
from storage.records.scene import Scene
from storage.records.texture import Environment
from storage.seeds import SceneKey, rng_for
from storage.settings.overrides import apply_overrides
from tests.for_each import for_each
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scene_templates.statistics import (
    choices,
    merged,
    require_plausible,
    share,
    stated_table,
    uniform,
    with_draws,
)


def _with_draws(family: str, seed: int, **changes: Any) -> tuple[NDArray, Mapping[str, Any]]:
    settings = apply_overrides(SkyMapSettings(families=(family,), height=32), changes)
    (_, radiance_rgb), draws = with_draws(draw_sky, rng_for(seed, "sky"), settings)
    return radiance_rgb, draws


def _sky(family: str, seed: int, **changes: Any) -> NDArray:
    return _with_draws(family, seed, **changes)[0]


@for_each("family", OUR_SKIES)
def test_parameters_are_distributed_as_stated(family: str) -> None:
    """On two texels, where a family draws the same and makes no picture."""

    def made(seed: int, coloured_share: float) -> SkyDraws:
        settings = SkyMapSettings(
            coloured_share=coloured_share, sun_elevation_deg=(10.0, 50.0), sun_to_sky=(1.0, 3.0)
        )
        draws = SkyDraws(rng_for(seed, "sky", int(coloured_share)), settings)
        SKIES[family](draws, SkyTexels(1))
        return draws

    for coloured_share in (0.0, 1.0):
        found = merged(made(seed, coloured_share).made for seed in range(60))
        assert len(found) >= 2
        require_plausible(stated_table(found))


@for_each("family", OUR_SKIES)
def test_the_mean_over_the_sphere_is_the_stated_one(family: str) -> None:
    for seed, height in enumerate((1, 2, 8, 33, 64)):
        found, draws = _with_draws(family, seed, height=height, coloured_share=float(seed % 2))
        assert found.shape == (height, 2 * height, 3) and found.dtype == np.float32
        assert np.isfinite(found).all() and (found >= 0).all()
        rows = (0.5 - (np.arange(height + 1)) / height) * math.pi
        weights = (np.sin(rows[:-1]) - np.sin(rows[1:])) / 2
        mean = (found.astype(float).mean(axis=(1, 2)) * weights).sum()
        # texels round to float32: 6e-8 each
        assert mean == pytest.approx(draws["mean radiance"][0], rel=1e-6)


def test_skies_without_light_and_with_suns_of_a_million_are_finite() -> None:
    for family in OUR_SKIES:
        assert (_sky(family, 0, mean_radiance=[0.0, 0.0]) == 0).all(), family
    sky = _sky("sun_and_sky", 0, height=256, sun_to_sky=[1e6, 1e6], mean_radiance=[1e3, 1e3])
    assert np.isfinite(sky).all()
    assert sky.max() > 1e6
    found = np.mean([_sky("clouds", seed) for seed in range(12)], axis=(0, 2, 3))
    assert found[0] > 1.3 * found[15]


@for_each("family", OUR_SKIES)
def test_the_same_seed_is_the_same_sky_at_every_height(family: str) -> None:
    (coarse, draws), (fine, again) = (_with_draws(family, 1, height=each) for each in (32, 64))
    assert draws == again
    moments = []
    for sky in (coarse, fine):
        texels, grey = SkyTexels(len(sky)), sky.astype(float).mean(axis=-1)
        moment = texels.flux(grey[..., None] * texels.directions)
        moments.append(moment / draws["mean radiance"][0])
    # the vector irradiance, of at most 4 pi times the mean; spots and edges lie within a texel of
    # 5.6 degrees, and clouds lose octaves
    assert np.abs(moments[0] - moments[1]).max() < 0.1 * 4 * math.pi, family


@for_each("family", OUR_SKIES)
def test_there_is_no_seam_where_the_edges_meet(family: str) -> None:
    """Nowhere are steps over the seam larger than all steps of maps that hold it elsewhere."""
    found = np.log1p(np.stack([_sky(family, seed, height=64) for seed in range(6)]))
    seam = np.square(found[:, :, 0] - found[:, :, -1]).mean()
    inside = np.square(np.diff(found, axis=2)).mean(axis=(0, 1, 3))
    # azimuths are uniform, so the seam is one of 128 columns like any other
    assert seam <= inside.max() * 1.0001 + 1e-12, family


DIGESTS = {
    "sun_and_sky": "67a604a1a4d2cb91",
    "clouds": "83d28fb9e3ddd048",
    "night": "13cc1bbccfd13153",
    "softboxes": "911498c9642f2673",
    "window_wall": "1f7f7a1936ae704f",
    "lobes": "249eb23b366b4fa8",
    "gradient": "9a46501cb415904a",
    "constant": "1846e0b0098bdfcc",
}
"""Of the maps of four seeds; a sky that is drawn otherwise is another one."""


def test_bytes_are_the_same_everywhere() -> None:
    """Also as other processors compute them: tests/elsewhere.py. Seeds decide them all."""
    for family in OUR_SKIES:
        made = [_sky(family, seed, height=64).tobytes() for seed in range(4)]
        assert hashlib.sha256(b"".join(made)).hexdigest()[:16] == DIGESTS[family], family
        assert len({_sky(family, seed).tobytes() for seed in (3, 4)}) == 2, family


def test_the_sun_is_the_brightest_texel_and_where_it_was_drawn() -> None:
    height = 64
    for seed in range(30):
        sky, draws = _with_draws("sun_and_sky", seed, height=height, sun_to_sky=[2.0, 8.0])
        brightest = np.argmax(sky.sum(axis=-1))
        row, column = np.unravel_index(brightest, (height, 2 * height))
        (towards,) = draws["sun"]
        u, v = uv_of(np.array(towards))
        assert abs((1 - v) * height - (row + 0.5)) <= 1
        across = abs(u * 2 * height - (column + 0.5))
        # a column is narrower above the horizon, by the cosine of the elevation
        cos_elevation = math.sqrt(1 - towards[2] ** 2)
        assert min(across, 2 * height - across) * cos_elevation <= 1


def _radiance(ratio: float, height: int, elevation: float) -> tuple[np.ndarray, SkyTexels]:
    settings = SkyMapSettings(
        coloured_share=0.0, sun_elevation_deg=(elevation, elevation), sun_to_sky=(ratio, ratio)
    )
    draws = SkyDraws(rng_for(5, "sun"), settings)
    texels = SkyTexels(height)
    return SKIES["sun_and_sky"](draws, texels), texels


def test_the_sun_has_the_stated_irradiance_and_none_once_it_has_set() -> None:
    for ratio, height, elevation in itertools.product((0.5, 8.0, 1e6), (8, 64), (0.5, 50.0, 90.0)):
        # What it adds above the horizon, over what the rest sends onto a horizontal plane.
        without, texels = _radiance(0.0, height, elevation)
        with_sun, _ = _radiance(ratio, height, elevation)
        above = texels.z > 0
        added = texels.flux((with_sun - without) * above[..., None])
        rest = texels.irradiance(without)
        # sums of a few thousand float64 numbers of which one is a million times the others
        assert float(added.mean()) == pytest.approx(ratio * float(rest.mean()), rel=1e-9)
    without, _ = _radiance(0.0, 64, -20.0)
    with_sun, _ = _radiance(1e6, 64, -20.0)
    np.testing.assert_array_equal(with_sun, without)


def test_the_ground_reflects_what_it_receives() -> None:
    found, texels = _radiance(4.0, 64, 30.0)
    received = texels.irradiance(found)
    ground = found[-1, 0]
    assert (found[40:] == ground).all()
    share = ground * math.pi / received
    # an albedo of 0.05 to 0.5, times a tint of 0.5 to 1
    assert (share > 0.02).all() and (share < 0.5).all()


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


def test_solid_angles_sum_to_the_sphere_and_no_sky_can_write_into_those_of_the_next_one() -> None:
    """And a white one sends pi onto the ground."""
    for height in (1, 2, 7, 64):
        texels = SkyTexels(height)
        white = np.ones((height, 2 * height, 3))
        np.testing.assert_allclose(texels.flux(white), 4 * math.pi, rtol=1e-13)
        assert texels.solid_angle.shape == (height, 1) and (texels.solid_angle > 0).all()
        shared = (texels.directions, texels.z, texels.solid_angle)
        assert not any(array.flags.writeable for array in shared)
    # the midpoint rule on 64 rows errs by (pi / 64)^2 / 6
    np.testing.assert_allclose(texels.irradiance(white), math.pi, rtol=5e-4)


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
        across, up = (side / math.sqrt(1 + side**2) for side in half)
        expected = 4 * math.asin(across * up)
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


def test_a_black_body_has_the_colour_of_plancks_law() -> None:
    """Colours are positive with a mean of 1, and there is no jump."""
    metres = WAVELENGTHS_NM * 1e-9
    for mired in (40, 80, 153.8, 249, 251, 300, 400, 449, 451, 499):
        spectrum = metres**-5 / np.expm1(0.014387769 / metres / (1e6 / mired))
        rgb = _XYZ_TO_REC709 @ (OBSERVER @ spectrum)
        # both fits are good to about 0.003 of a chromaticity, up to 2 % of a channel's mean of 1
        np.testing.assert_allclose(planckian_rgb(mired), rgb / rgb.mean(), atol=0.04)
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


def _drawn(settings: SkySettings, count: int = 2000) -> list[tuple[Environment, dict[str, Any]]]:
    """Return the skies of the scenes that have one, with their provenance."""
    keys = [SceneKey(3, index) for index in range(count)]
    return [sky[:2] for key in keys if (sky := scene_sky(settings, LAMP, RADIANCE, key))]


def test_shares_families_strengths_and_turns_are_as_stated() -> None:
    settings = SkySettings(share=0.4, over_lamps_log=(0.1, 10.0), seen_share=0.3, maps=SMALL)
    found = _drawn(settings)
    families = [origin["family"] for _, origin in found]
    log = np.log10([origin["over_lamps"] for _, origin in found])
    turns_deg = np.array([origin["azimuth_deg"] for _, origin in found])
    assert abs(log).max() <= 1 and turns_deg.min() >= 0 and turns_deg.max() <= 360
    require_plausible(
        {
            "share": share(np.arange(2000) < len(found), 0.4),
            "seen": share([environment.is_seen for environment, _ in found], 0.3),
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
    found = _drawn(SkySettings(share=1.0, maps=SMALL), 20)
    assert len(found) == 20
    for environment, origin in found:
        grey = environment.radiance_rgb.astype(np.float64).mean(axis=(1, 2))
        weight = np.diff(np.sin(np.linspace(-np.pi / 2, np.pi / 2, 9)))[::-1] / 2
        # Float32 texels.
        assert np.pi * (grey @ weight) == pytest.approx(origin["over_lamps"] * lamps, rel=1e-5)
        environment.check()
        assert environment.rotation[2].tolist() == [0, 0, 1]


def test_only_the_sky_is_new() -> None:
    """Objects, materials, lights and cameras are those of the preset without skies."""
    plain = preset_settings("pretrain-256").scenes
    skies = preset_settings("sky-256").scenes
    assert dataclasses.replace(skies, skies=SkySettings()) == plain
    every = dataclasses.replace(skies.skies, share=1.0, maps=SMALL)
    always = dataclasses.replace(skies, skies=every)
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
