"""Skies: directions drawn as their density says, symmetries, and networks that know them."""

import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model.config import ModelConfig
from model.neural_renderer import NeuralRenderer
from model.renderformer import radiance
from model.scene_tensors import scene_tensors
from model.sky.sampler import SkySampler
from model.sky.symmetries import mirror_sky, permute_sky_channels, rotate_sky, scale_sky
from scene_templates.rotations import uniform_rotation
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.lookup import environment_values
from storage.records.sky_texels import row_solid_angles, texel_means
from tests.for_each import for_each
from tests.model.hits.kit import corner
from tests.model.hits.test_decoder import hits_config
from tests.model.kit import awake, render, tiny_config
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
    drawn = SkySampler(sky)
    direction = drawn.sample_directions(np.random.default_rng(0).random((2, 40_000), np.float32))
    assert np.abs(np.linalg.norm(direction, axis=0) - 1).max() < 1e-6
    radiance = drawn.radiance(direction)
    expected = environment_values(sky, direction.T).T
    assert np.abs(radiance - expected).max() <= 1e-6 * expected.max()  # float32
    ratio = radiance / drawn.pdf(direction)
    error = ratio.std(axis=1) / 200
    # Texels count with the mean over their area, the integral at centres: 1 % for a coarse map.
    assert (np.abs(ratio.mean(axis=1) - _light(sky)) < 5 * error + 0.01 * _light(sky)).all()


@for_each("name", ["smooth", "night"])
def test_directions_fall_into_texels_as_often_as_stated(name: str) -> None:
    sky = SKIES[name]()
    drawn = SkySampler(sky)
    direction = drawn.sample_directions(np.random.default_rng(1).random((2, 100_000), np.float32))
    up = direction[2] > 0.4
    other = np.random.default_rng(2).normal(size=(3, 100_000))
    other /= np.linalg.norm(other, axis=0)
    density = drawn.pdf(other.astype(np.float32))
    assert density.mean() * 4 * np.pi == pytest.approx(1, abs=0.05)
    expected = (density * (other[2] > 0.4)).mean() * 4 * np.pi
    assert up.mean() == pytest.approx(expected, abs=0.02)  # 100,000 draws: 0.2 %, peaked 2 %


def test_the_ends_of_the_unit_square_are_directions() -> None:
    last = np.nextafter(np.float32(1), np.float32(0))
    u = np.array([[0, 0, last, last], [0, last, 0, last]], np.float32)
    for make in SKIES.values():
        drawn = SkySampler(make())
        direction = drawn.sample_directions(u)
        assert np.isfinite(direction).all()
        assert (drawn.pdf(direction) >= 0).all()


def test_a_sun_is_found_by_most_draws() -> None:
    drawn = SkySampler(one_sun(1e6))
    direction = drawn.sample_directions(np.random.default_rng(0).random((2, 1_000), np.float32))
    assert np.mean(drawn.radiance(direction).max(axis=0) > 100) > 0.7


@for_each("height", [1, 16, 50, 64])
def test_a_blurred_sky_has_as_much_light(height: int) -> None:
    rng = np.random.default_rng(height)
    sky = as_sky(rng.uniform(size=(height, 2 * height, 3)) ** 8)
    drawn = SkySampler(sky)
    other = rng.normal(size=(3, 50_000))
    other = (other / np.linalg.norm(other, axis=0)).astype(np.float32)
    sharp, soft = drawn.radiance(other), drawn.blurred_radiance(other)
    assert soft.mean() == pytest.approx(sharp.mean(), rel=0.03)
    assert soft.std() <= sharp.std() + 1e-6


def test_scene_and_sky_turned_together_have_the_same_draws_elsewhere() -> None:
    u = np.random.default_rng(0).random((2, 500), np.float32)
    there = SkySampler(smooth(rotation=TURN)).sample_directions(u)
    assert np.abs(TURN @ SkySampler(smooth()).sample_directions(u) - there).max() < 1e-6


SKY = smooth(rotation=uniform_rotation(np.random.default_rng(8)).astype(np.float32))
DIRECTIONS = np.random.default_rng(0).normal(size=(500, 3))
HERE = environment_values(SKY, DIRECTIONS)


def test_light_comes_from_where_a_symmetry_puts_it() -> None:
    """Rotations are kept in float32, by which this sky changes by less than 1e-6."""
    rotation, sides = uniform_rotation(np.random.default_rng(9)), np.array([-1, 1, 1], np.float32)
    there = environment_values(rotate_sky(SKY, rotation), DIRECTIONS @ rotation.T)
    assert np.abs(there - HERE).max() < 3e-6
    mirrored = mirror_sky(SKY, sides)
    mirrored.check()
    assert np.abs(environment_values(mirrored, DIRECTIONS * sides) - HERE).max() < 3e-6
    twice = mirror_sky(mirrored, sides)
    assert np.array_equal(twice.radiance_rgb, SKY.radiance_rgb)
    assert np.array_equal(twice.rotation, SKY.rotation)
    order = np.array([1, 2, 0])
    assert np.array_equal(
        environment_values(permute_sky_channels(SKY, order), DIRECTIONS), HERE[:, order]
    )
    assert np.abs(environment_values(scale_sky(SKY, 3.0), DIRECTIONS) - 3 * HERE).max() < 1e-6


@for_each("config", [tiny_config(), hits_config()])
def test_networks_that_know_no_sky_refuse_it_and_say_so_when_rendering(config: ModelConfig) -> None:
    network, below = awake(config, torch.float32), corner(sky=smooth())
    with pytest.raises(TrilightError, match=r"does not know its light.*sky_rays=16.*share=0"):
        render(network, scene_tensors(below))
    with pytest.warns(UserWarning, match="does not know: it is missing here"):
        shown = NeuralRenderer(network).render(below, 32)
    assert np.array_equal(shown, NeuralRenderer(network).render(corner(), 32))


def test_a_sky_that_cameras_see_is_refused_and_left_black() -> None:
    network = awake(hits_config(sky_rays=2), torch.float32)
    seen = corner(sky=smooth(is_seen=True))
    with pytest.raises(TrilightError, match=r"cameras see its environment.*seen_share=0"):
        render(network, scene_tensors(seen))
    with pytest.warns(UserWarning, match="networks leave it black"):
        shown = NeuralRenderer(network).render(seen, 32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hidden = NeuralRenderer(network).render(corner(sky=smooth()), 32)
    assert np.array_equal(shown, hidden)


def test_hits_scale_with_all_light_exactly() -> None:
    """The sky is in the scene's unit, as lamps are: ten times the light, ten times the picture."""
    network = awake(hits_config(sky_rays=2), torch.float32)
    once, tenfold = (
        radiance(render(network, scene_tensors(corner(radiance=lamp, sky=constant(sky)))).double())
        for lamp, sky in ((20.0, 0.4), (200.0, 4.0))
    )
    # float32 throughout; log10(1 + x) of the darkest pixels has the fewest digits
    assert ((tenfold - 10 * once).abs() < 2e-4 * tenfold + 2e-5).all()
