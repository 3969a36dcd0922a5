"""Laws that every family of skies keeps: drawn as stated, lit as stated, seamless, reproducible."""

import hashlib
import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_templates.skies.procedural_skies import (
    OUR_SKIES,
    SKIES,
    SkyDraws,
    SkyMapSettings,
    draw_sky,
)
from scene_templates.skies.texels import SkyTexels
from storage.seeds import rng_for
from storage.settings.overrides import apply_overrides
from tests.for_each import for_each
from tests.scene_templates.drawn_values import with_draws
from tests.scene_templates.skies.test_skies import uv_of
from tests.scene_templates.statistics import merged, require_plausible, stated_table

MANY = 60


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
        found = merged(made(seed, coloured_share).made for seed in range(MANY))
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
    moments = [
        SkyTexels(len(sky)).flux(
            sky.astype(float).mean(axis=-1)[..., None] * SkyTexels(len(sky)).directions
        )
        / draws["mean radiance"][0]
        for sky in (coarse, fine)
    ]
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
