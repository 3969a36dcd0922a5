"""Directions drawn from a map: as often as there is light, with the density that is stated."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from model.sky.drawn import DrawnSky
from scene_templates.rotations import uniform_rotation
from storage.records.environment import Environment
from storage.records.lookup import environment_values
from storage.records.sky_texels import row_solid_angles, texel_means
from tests.for_each import for_each
from tests.sky_maps import as_sky, constant, night, one_sun, six_poles, smooth

TURN = uniform_rotation(np.random.default_rng(3)).astype(np.float32)

SKIES: dict[str, Callable[[], Environment]] = {
    "constant": lambda: constant(2.0, height=1),
    "smooth": lambda: smooth(rotation=TURN),
    "sun": lambda: one_sun(1e6, rotation=TURN),
    "night": night,
    "poles": six_poles,
}


def _light(sky: Environment) -> NDArray[np.float64]:
    """Return the integral of a map over the sphere, as it is interpolated."""
    angles = row_solid_angles(len(sky.radiance_rgb))[:, None]
    channels = np.moveaxis(sky.radiance_rgb.astype(np.float64), -1, 0)
    return np.array([(texel_means(channel) * angles).sum() for channel in channels])


@for_each("name", SKIES)
def test_light_over_density_is_the_light_of_the_map(name: str) -> None:
    sky = SKIES[name]()
    drawn = DrawnSky(sky)
    direction = drawn.drawn(np.random.default_rng(0).random((2, 40_000), np.float32))
    assert np.abs(np.linalg.norm(direction, axis=0) - 1).max() < 1e-6
    radiance = drawn.radiance(direction)
    expected = environment_values(sky, direction.T).T
    assert np.abs(radiance - expected).max() <= 1e-6 * expected.max()  # float32
    ratio = radiance / drawn.density(direction)
    error = ratio.std(axis=1) / 200
    # Texels count with the mean over their area, the integral at centres: 1 % for a coarse map.
    assert (np.abs(ratio.mean(axis=1) - _light(sky)) < 5 * error + 0.01 * _light(sky)).all()


@for_each("name", ["smooth", "night"])
def test_directions_fall_into_texels_as_often_as_stated(name: str) -> None:
    sky = SKIES[name]()
    drawn = DrawnSky(sky)
    direction = drawn.drawn(np.random.default_rng(1).random((2, 100_000), np.float32))
    up = direction[2] > 0.4
    other = np.random.default_rng(2).normal(size=(3, 100_000))
    other /= np.linalg.norm(other, axis=0)
    density = drawn.density(other.astype(np.float32))
    assert density.mean() * 4 * np.pi == pytest.approx(1, abs=0.05)
    expected = (density * (other[2] > 0.4)).mean() * 4 * np.pi
    assert up.mean() == pytest.approx(expected, abs=0.02)  # 100,000 draws: 0.2 %, peaked 2 %


def test_the_ends_of_the_unit_square_are_directions() -> None:
    last = np.nextafter(np.float32(1), np.float32(0))
    u = np.array([[0, 0, last, last], [0, last, 0, last]], np.float32)
    for make in SKIES.values():
        drawn = DrawnSky(make())
        direction = drawn.drawn(u)
        assert np.isfinite(direction).all()
        assert (drawn.density(direction) >= 0).all()


def test_a_sun_is_found_by_most_draws() -> None:
    drawn = DrawnSky(one_sun(1e6))
    direction = drawn.drawn(np.random.default_rng(0).random((2, 1_000), np.float32))
    assert np.mean(drawn.radiance(direction).max(axis=0) > 100) > 0.7


@for_each("height", [1, 16, 50, 64])
def test_a_blurred_sky_has_as_much_light(height: int) -> None:
    rng = np.random.default_rng(height)
    sky = as_sky(rng.uniform(size=(height, 2 * height, 3)) ** 8)
    drawn = DrawnSky(sky)
    other = rng.normal(size=(3, 50_000))
    other = (other / np.linalg.norm(other, axis=0)).astype(np.float32)
    sharp, soft = drawn.radiance(other), drawn.blurred(other)
    assert soft.mean() == pytest.approx(sharp.mean(), rel=0.03)
    assert soft.std() <= sharp.std() + 1e-6


def test_scene_and_sky_turned_together_have_the_same_draws_elsewhere() -> None:
    u = np.random.default_rng(0).random((2, 500), np.float32)
    there = DrawnSky(smooth(rotation=TURN)).drawn(u)
    assert np.abs(TURN @ DrawnSky(smooth()).drawn(u) - there).max() < 1e-6
