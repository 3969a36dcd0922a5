"""Skies: directions drawn as their density says, light at hits, and networks that know them.

Closed forms, and nothing where there is no sky. Beside the path tracer: tests/laws.
"""

import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model.config import ModelConfig
from model.hits.direct_light import add_sky_light, escaped_light, no_light, sees_sky
from model.hits.lit_scene import SkySampler, gloss_at, sample_lobe
from model.hits.radiosity import scene_light
from model.hits.view_inputs import Channel
from model.inference import NeuralRenderer
from model.renderformer import radiance
from model.scene_tensors import scene_tensors
from scene_templates.rotations import uniform_rotation
from storage.errors import TrilightError
from storage.records.lookup import environment_values
from storage.records.scene import Scene
from storage.records.texture import Environment, row_solid_angles, texel_means
from tests.for_each import for_each
from tests.model.hits.kit import FLOOR, corner, direct, lit_scene, traced
from tests.model.kit import awake, hits_config, render, tiny_config
from tests.pipeline.renders.scene_kit import join, material, quad, sphere
from tests.sky_maps import as_sky, constant, night, one_sun, six_poles, smooth
from tests.train.kit import bare_scene
from train.data.augment import mirror_scene, move_scene, permute_channels, scale_light
from train.data.scenes import TrainingScene


def _floor(sky: Environment) -> Scene:
    parts = [quad(FLOOR, material(diffuse=0.5, specular=0.0))]
    return join(parts, eye=(0, 0.1, 3), target=(0, 0, 0), fov_deg=40, sky=sky)


def test_a_plane_below_a_constant_sky_receives_its_radiance() -> None:
    """Irradiance over pi is the radiance: a sky all around, and half of it above."""
    inputs = traced(_floor(constant((0.5, 1.0, 2.0))), sky_rays=16)
    found = inputs.pixels[..., Channel.DIRECT_DIFFUSE].mean(axis=(0, 1))
    # 1,024 pixels of 16 rays, half of them by the cosine, the others even: 0.3 %.
    assert found == pytest.approx(np.array([0.5, 1.0, 2.0]), rel=0.01)
    assert inputs.pixels[..., Channel.OPEN_DIFFUSE].mean(axis=(0, 1)) == pytest.approx(found)


def test_below_a_roof_a_sky_gives_what_comes_from_the_sides() -> None:
    """Under the middle of a square roof a constant sky lacks the roof's view factor.

    With a = half width over height: 4 x 1/(2 pi) x 2 x a/sqrt(1 + a^2) x atan(a/sqrt(1 + a^2)).
    """
    roof = [[-0.5, -0.5, 0.5], [0.5, -0.5, 0.5], [0.5, 0.5, 0.5], [-0.5, 0.5, 0.5]]
    parts = [quad(FLOOR, material(diffuse=0.5)), quad(roof, material(diffuse=0.0))]
    scene = join(parts, eye=(1.2, 0, 0.25), target=(0, 0, 0), fov_deg=1, sky=constant(1.0))
    inputs = traced(scene, 8, sky_rays=64)
    slope = 1 / np.sqrt(2)
    hidden = 4 / (2 * np.pi) * 2 * slope * np.arctan(slope)
    found = inputs.pixels[..., Channel.DIRECT_DIFFUSE].mean()
    assert inputs.pixels[..., Channel.OPEN_DIFFUSE].mean() == pytest.approx(1, rel=0.03)
    assert found == pytest.approx(1 - hidden, abs=0.03)  # 64 pixels of 64 rays and more: 1 %


@for_each("roughness", [0.05, 0.3, 0.8])
def test_a_white_ball_in_a_white_sky_is_white(roughness: float) -> None:
    """Convex, energy-conserving, and lit from everywhere: direct light alone makes it vanish."""
    thing = sphere([0, 0, 0], 0.4, material(diffuse=0.0, specular=1.0, roughness=roughness))
    scene = join([thing], eye=(0.3, -2, 0.4), fov_deg=24, sky=constant(1.0))
    inputs = [traced(scene, sky_rays=8, seed=seed) for seed in range(2)]
    picture = np.mean([direct(each) for each in inputs], axis=0)
    full = np.all([each.pixels[..., 0] == 1 for each in inputs], axis=0)
    # Noise of 2 x 4 x 8 rays a pixel and 500 pixels: 0.4 %; triangles of a ball shade their rims.
    assert picture[full].mean() == pytest.approx(1.0, abs=0.02)


def test_scenes_without_a_sky_stay_as_they_are_to_the_bit() -> None:
    plain, asked = traced(corner(), sky_rays=0), traced(corner(), sky_rays=8)
    for name, value in plain._asdict().items():
        assert np.array_equal(value, getattr(asked, name)), name


def test_a_sky_joins_the_unit_and_what_triangles_receive() -> None:
    """Twice the light is twice the unit; without lamps the sky alone is the unit."""
    without, below = (scene_light(lit_scene(corner(sky=sky))) for sky in (None, constant(1.0)))
    double = scene_light(lit_scene(corner(sky=constant(2.0))))
    assert without.sky_2T3 is None and below.sky_2T3 is not None and double.sky_2T3 is not None
    assert double.sky_2T3 == pytest.approx(2 * below.sky_2T3, rel=1e-5)
    assert (below.mean_3 > without.mean_3).all()
    assert below.but_lamps_2T3 == pytest.approx(below.indirect_2T3 + below.sky_2T3)
    dark = scene_light(lit_scene(corner(radiance=0.0, sky=constant((1.0, 0.0, 0.0)))))
    assert dark.mean_3[0] > 0.1
    assert dark.mean_3[1] == pytest.approx(0.03 * dark.mean_3[0], rel=1e-5)


@for_each("sky", [one_sun(1e6), constant(1e9), constant(1e-9, height=1)])
def test_extreme_skies_are_finite(sky: Environment) -> None:
    inputs = traced(corner(sky=sky), sky_rays=3)
    assert all(np.isfinite(value).all() for value in inputs)


def test_the_lobe_ray_and_the_others_share_what_a_mirror_shows() -> None:
    """A ball in a smooth sky: with and without rays by the lobe the same light."""
    scene = corner(radiance=0.0, roughness=0.3, sky=smooth())
    lit = lit_scene(scene)
    eye = np.array([1.0, -3.0, 1.4], np.float32)
    toward = np.array([[0.5, -0.2, 0.4]] * 4_000, np.float32) - eye
    rays = (toward / np.linalg.norm(toward, axis=1)[:, None]).T.astype(np.float32)
    hits = lit.first_hits(eye, rays)
    assert (hits.triangle >= 0).all()
    points = lit.points(hits.triangle, hits.uv, rays)
    light, gloss = no_light(points), gloss_at(lit, points)
    shift = np.random.default_rng(0).random((2, 4_000), np.float32)
    add_sky_light(light, lit, points, gloss, shift, 0, rays=8, lobe_rays=0)
    alone = light.specular.mean(axis=1)
    shared = no_light(points)
    add_sky_light(shared, lit, points, gloss, shift, 0, rays=8, lobe_rays=1)
    direction, weight = sample_lobe(
        gloss, points, np.random.default_rng(1).random((2, 4_000), np.float32)
    )
    free = sees_sky(lit, points, direction) & (weight > 0)
    escaped = escaped_light(lit, points, gloss, direction, weight, 8) * free
    together = shared.specular.mean(axis=1) + escaped.mean(axis=1)
    assert escaped.mean() > 0.1 * together.mean()
    assert together == pytest.approx(alone, rel=0.03)  # 32,000 rays of a narrow lobe: 1 %


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


def test_light_comes_from_where_a_symmetry_of_training_puts_it() -> None:
    """Rotations are kept in float32, by which this sky changes by less than 1e-6."""

    def sky_of(training: TrainingScene) -> Environment:
        sky = training.tensors.sky
        assert sky is not None
        sky.check()
        return sky

    turned = smooth(rotation=uniform_rotation(np.random.default_rng(8)).astype(np.float32))
    directions = np.random.default_rng(0).normal(size=(500, 3))
    here = environment_values(turned, directions)
    below = bare_scene(scene_tensors(corner(sky=turned)))
    rotation, sides = uniform_rotation(np.random.default_rng(9)), np.array([-1, 1, 1], np.float32)
    moved = move_scene(below, torch.from_numpy(rotation), torch.tensor([0.4, -0.1, 0.2]))
    there = environment_values(sky_of(moved), directions @ rotation.T)
    assert np.abs(there - here).max() < 3e-6
    mirrored = mirror_scene(below)
    assert np.abs(environment_values(sky_of(mirrored), directions * sides) - here).max() < 3e-6
    twice = sky_of(mirror_scene(mirrored))
    assert np.array_equal(twice.radiance_rgb, turned.radiance_rgb)
    assert np.array_equal(twice.rotation, turned.rotation)
    order = np.array([1, 2, 0])
    permuted = sky_of(permute_channels(below, order))
    assert np.array_equal(environment_values(permuted, directions), here[:, order])
    scaled = sky_of(scale_light(below, 3.0))
    assert np.abs(environment_values(scaled, directions) - 3 * here).max() < 1e-6


@for_each("config", [tiny_config(), hits_config()])
def test_networks_that_know_no_sky_refuse_it_and_say_so_when_rendering(config: ModelConfig) -> None:
    network, below = awake(config, torch.float32), corner(sky=smooth())
    with pytest.raises(TrilightError, match=r"does not know its light.*sky_rays=16.*share=0"):
        render(network, scene_tensors(below))
    with pytest.warns(UserWarning, match="does not know: it is missing here"):
        shown = NeuralRenderer(network).render(below, 32)
    assert np.array_equal(shown, NeuralRenderer(network).render(corner(), 32))
    assert not any(
        "environment" in note for note in NeuralRenderer(network).prepare(corner()).notes
    )


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
