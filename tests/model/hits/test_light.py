"""Reflected, gathered and filtered light: beside closed forms and slow twins.

Skies: directions drawn as their density says, light at hits, and networks that know them. Closed
forms, and nothing where there is no sky. Beside the path tracer: tests/laws.
"""

import warnings
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.config import ModelConfig
from model.hits.anchors import anchor_pixels
from model.hits.decoder import (
    _ALIKE,
    _MOST_DOUBT,
    STEPS_PX,
    TAPS,
    LightFilter,
    _mean_around,
)
from model.hits.direct_light import escaped_light, sees_sky, sky_light
from model.hits.lit_scene import (
    Gloss,
    LitScene,
    Points,
    SkySampler,
    gloss_at,
    lobe,
    sample_lobe,
)
from model.hits.radiosity import BOUNCES, scene_light
from model.hits.vectors import dot, unit
from model.hits.view_inputs import Channel
from model.inference import NeuralRenderer
from model.renderformer import radiance
from model.scene_tensors import scene_tensors
from scene_templates.rotations import uniform_rotation
from storage.errors import TrilightError
from storage.optics import directional_albedo
from storage.records.lookup import environment_values
from storage.records.texture import Environment, row_solid_angles, texel_means
from tests.for_each import for_each
from tests.model.hits.kit import FLOOR, LAMP, corner, direct, lit_scene, traced
from tests.model.kit import awake, hits_config, render, tiny_config
from tests.pipeline.renders.sampling import lambert_irradiance
from tests.pipeline.renders.scene_kit import box, join, light, material, quad, sphere
from tests.sky_maps import as_sky, constant, night, one_sun, six_poles, smooth
from tests.train.kit import bare_scene
from train.data.augment import mirror_scene, move_scene, permute_channels, scale_light
from train.data.scenes import TrainingScene

COUNT = 20_000


def _plate(roughness: float, toward: np.ndarray) -> tuple[Gloss, Points]:
    """Return the gloss and the points of a white plate, seen from these directions."""
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float32)
    materials = np.zeros((1, 10), np.float32)
    materials[0, 3:6], materials[0, 6] = 1.0, roughness
    scene = LitScene(corners, np.tile(np.array([0, 0, 1], np.float32), (1, 3, 1)), materials)
    count = toward.shape[1]
    uv = np.full((2, count), 0.25, np.float32)
    points = scene.points(np.zeros(count, np.intp), uv, -toward.astype(np.float32))
    return gloss_at(scene, points), points


def _toward(cosine: float, count: int = COUNT) -> np.ndarray:
    sine = np.sqrt(1 - cosine**2)
    return np.tile(np.array([[sine], [0.0], [cosine]], np.float32), (1, count))


@for_each("roughness", [0.1, 0.3, 0.6, 1.0])
@for_each("cosine", [0.95, 0.4, 0.1])
def test_a_white_lobe_returns_all_light(roughness: float, cosine: float) -> None:
    """Single scattering by drawn directions, and the scale for the rest: together 1."""
    gloss, points = _plate(roughness, _toward(cosine))
    u = np.random.default_rng(0).random((2, COUNT), np.float32)
    _, weight = sample_lobe(gloss, points, u)
    alpha = roughness**2
    stretch = np.sqrt(cosine**2 + alpha**2 * (1 - cosine**2))
    single = directional_albedo(cosine / stretch, alpha, "correlated")
    # standard error of weights between 0 and 1, five times; then the table's 0.25 % between entries
    assert weight.mean() == pytest.approx(float(single), abs=5 * 0.5 / np.sqrt(COUNT))
    assert float(single) * gloss.color[0, 0] == pytest.approx(1.0, abs=4e-3)


@for_each("roughness", [0.15, 0.4, 0.9])
def test_a_sample_weighs_its_value_over_its_density(roughness: float) -> None:
    gloss, points = _plate(roughness, _toward(0.6, 500))
    u = np.random.default_rng(1).random((2, 500), np.float32)
    direction, weight = sample_lobe(gloss, points, u)
    value, density = lobe(gloss, points, direction, dot(direction, points.normal))
    goes = weight > 0
    assert goes.mean() > 0.7
    # half vectors in single precision, of a lobe as narrow as 0.02
    np.testing.assert_allclose(value[goes] / density[goes], weight[goes], rtol=0.02)


@for_each("roughness", [0.3, 0.8])
def test_the_density_integrates_to_what_is_drawn_above(roughness: float) -> None:
    """Over the hemisphere, by even directions: all that is drawn and not lost below."""
    rng = np.random.default_rng(2)
    height, turn = rng.random(COUNT), 2 * np.pi * rng.random(COUNT)
    radius = np.sqrt(1 - height**2)
    even = np.stack([radius * np.cos(turn), radius * np.sin(turn), height]).astype(np.float32)
    gloss, points = _plate(roughness, _toward(0.7))
    _, density = lobe(gloss, points, even, even[2])
    _, weight = sample_lobe(gloss, points, rng.random((2, COUNT)).astype(np.float32))
    spread = 2 * np.pi * density.std() / np.sqrt(COUNT)
    assert 2 * np.pi * density.mean() == pytest.approx((weight > 0).mean(), abs=5 * spread + 0.01)


def test_the_lobe_is_symmetric_but_for_its_scale_and_nothing_below_is_reflected() -> None:
    """D G2 / 4 / cosines: exchanging viewer and light changes nothing."""
    rng = np.random.default_rng(3)
    a, b = (unit(rng.normal(size=(3, 300)).astype(np.float32)) for _ in range(2))
    a[2], b[2] = np.abs(a[2]) + 0.05, np.abs(b[2]) + 0.05
    a, b = unit(a), unit(b)
    there = lobe(*_plate(0.5, a), b, b[2])[0] / b[2]
    back = lobe(*_plate(0.5, b), a, a[2])[0] / a[2]
    np.testing.assert_allclose(there, back, rtol=1e-3)
    below = np.array([[0.6, 0.0], [0.0, 0.8], [-0.8, -0.6]], np.float32)
    value, _ = lobe(*_plate(0.3, _toward(0.5, 2)), below, below[2])
    assert not value.any()


def test_each_part_has_its_own_anchor_and_prefers_what_is_met() -> None:
    coverage = np.zeros((8, 8), np.float32)
    coverage[0, 3] = 0.25  # in the part at the top left, far from its middle
    pixels = anchor_pixels(coverage, 2)
    rows, columns = pixels // 8, pixels % 8
    assert list(zip(rows // 4, columns // 4, strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert (rows[0], columns[0]) == (0, 3)
    assert abs(rows[1] - 1.5) < 1, "where nothing tells them apart, the most central"
    assert np.array_equal(anchor_pixels(np.ones((4, 4), np.float32), 4), np.arange(16))


def test_light_gathered_beside_a_bright_wall_is_that_of_its_view() -> None:
    """A floor beside a white wall that a far lamp lights evenly: Lambert's formula, twice."""
    wall = np.array([[-3, 1, 0.0], [3, 1, 0], [3, 1, 6], [-3, 1, 6]])
    lamp = np.array([[-1, -40, 3.0], [1, -40, 3], [0, -40, 5]])
    parts = [quad(FLOOR, material()), quad(wall, material(diffuse=1.0)), light(lamp, 4000.0)]
    scene = join(parts, eye=(0, -1, 2), target=(0, 0, 0), fov_deg=2.0)
    inputs = traced(scene, 8, anchors_a_side=4, gather_rays=256)
    middle = wall.mean(axis=0, keepdims=True)
    radiance = lambert_irradiance(middle, np.array([0, -1.0, 0]), lamp, 4000.0) / np.pi
    seen = lambert_irradiance(np.zeros((1, 3)), np.array([0, 0, 1.0]), wall, float(radiance[0]))
    # the lamp lights the rim of the wall 2 % less; the black floor takes nothing part in it
    assert inputs.gathered.mean() == pytest.approx(float(seen[0]) / np.pi, rel=0.03)


def test_more_rays_less_noise_the_same_mean_and_nothing_where_nothing_is_met() -> None:
    few = [traced(corner(), gather_rays=8, seed=seed).gathered for seed in range(12)]
    many = [traced(corner(), gather_rays=128, seed=seed).gathered for seed in range(4)]
    error = np.std([x.mean() for x in few], ddof=1) / np.sqrt(len(few))
    assert abs(np.mean(few) - np.mean(many)) < 5 * error + 1e-3 * np.mean(many)
    assert np.std(many, axis=0).mean() < 0.6 * np.std(few, axis=0).mean()
    inputs = traced(corner(), 32)
    met = inputs.pixels.reshape(-1, inputs.pixels.shape[-1])[inputs.anchor, Channel.COVERAGE]
    assert not inputs.gathered[met[:, 0] == 0].any()
    assert inputs.gathered[met[:, 0] > 0].any()


def test_direct_light_is_that_of_lamberts_formula() -> None:
    plate = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    scene = join([quad(plate, material(diffuse=0.5)), light(LAMP, 7.0)])
    got = scene_light(lit_scene(scene)).direct_2T3
    wanted = lambert_irradiance(np.zeros((1, 3)), np.array([0, 0, 1.0]), np.array(LAMP), 7.0)
    # four points of a lamp that is seen under a few degrees
    assert got[0, :2].mean() == pytest.approx(float(wanted[0]) / np.pi, rel=0.05)
    assert not got[1, :2].any(), "the back of the plate is dark"


def test_a_closed_room_reflects_as_often_as_is_added_up() -> None:
    """Whatever leaves a wall arrives at another: with albedo a, sum of a^k for the bounces."""
    albedo = 0.5
    lamp = [[-0.2, -0.2, 0.1], [0.2, -0.2, 0.1], [0, 0.2, 0.1]]
    scene = lit_scene(join([box([0, 0, 0], 2.0, material(diffuse=albedo)), light(lamp, 10.0)]))
    found = scene_light(scene)
    inner = 1  # corners run counter-clockwise seen from outside
    walls = scene.area[:12, None]
    direct = (found.direct_2T3[inner, :12] * walls).sum()
    indirect = (found.indirect_2T3[inner, :12] * walls).sum()
    wanted = sum(albedo**k for k in range(1, BOUNCES + 1))
    # 12 triangles with 32 rays each, and a lamp that stands in the way of 2 % of them
    assert indirect / direct == pytest.approx(wanted, rel=0.1)
    assert not found.direct_2T3[0, :12].any(), "outside it is dark"


TOLD = 5


def awake_filter(seed: int = 0, size: float = 0.5) -> LightFilter:
    """Return a filter none of whose parts is zero; the smaller its weights, the more it mixes."""
    generator = torch.Generator().manual_seed(seed)
    found = LightFilter(TOLD, 16).double()
    with torch.no_grad():
        for weight in found.parameters():
            weight.copy_(size * torch.randn(weight.shape, generator=generator))
    return found


def drawn_light(px: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Return what pixels are told, their light and their specular albedo."""
    generator = torch.Generator().manual_seed(seed)
    told = torch.randn(1, px, px, TOLD, generator=generator, dtype=torch.float64)
    albedo = torch.rand(1, px, px, 3, generator=generator, dtype=torch.float64)
    light = albedo * torch.rand(1, px, px, 3, generator=generator, dtype=torch.float64).exp()
    return told, light, albedo


def test_even_light_stays_what_it_is_and_no_light_is_made() -> None:
    """A mixture of light without albedo lies between the least and the most of its colour."""
    told, _, albedo = drawn_light(24)
    with torch.no_grad():
        mixed = awake_filter()(told, 3.0 * albedo, albedo)
    torch.testing.assert_close(mixed, 3.0 * albedo, rtol=1e-12, atol=1e-12)
    told, light, albedo = drawn_light(32, seed=1)
    albedo = albedo.clamp(min=0.05)
    with torch.no_grad():
        mixed = awake_filter(1, size=0.1)(told, light, albedo) / albedo
    shown = light / albedo
    for colour in range(3):
        assert mixed[..., colour].min() >= shown[..., colour].min() * (1 - 1e-12)
        assert mixed[..., colour].max() <= shown[..., colour].max() * (1 + 1e-12)
    assert mixed.std() < 0.5 * shown.std(), "it does mix"


@for_each("step", STEPS_PX)
def test_a_level_is_its_slow_twin(step: int) -> None:
    px = 11
    generator = torch.Generator().manual_seed(step)
    alike = torch.randn(1, _ALIKE + 1, px, px, generator=generator, dtype=torch.float64)
    near = torch.randn(TAPS, generator=generator, dtype=torch.float64)
    both = torch.rand(1, 6, px, px, generator=generator, dtype=torch.float64)
    expected = torch.zeros_like(both)
    for row in range(px):
        for column in range(px):
            total = torch.zeros((), dtype=torch.float64)
            for tap in range(TAPS):
                y, x = row + (tap // 3 - 1) * step, column + (tap % 3 - 1) * step
                if not (0 <= y < px and 0 <= x < px):
                    continue
                apart = alike[0, :_ALIKE, row, column] - alike[0, :_ALIKE, y, x]
                trust = torch.sigmoid(alike[0, _ALIKE, y, x])
                share = torch.exp(near[tap] - apart.square().sum()) * trust
                expected[0, :, row, column] += share * both[0, :, y, x]
                total += share
            expected[0, :, row, column] /= total
    torch.testing.assert_close(LightFilter.mix_level(alike, near, both, step), expected)
    with torch.inference_mode():  # by rows, in parts
        torch.testing.assert_close(LightFilter.mix_level(alike, near, both, step), expected)


@for_each("px", [8, 40, 72])
def test_pictures_are_the_same_in_parts_and_whole(px: int) -> None:
    given, model = drawn_light(px, seed=2), awake_filter(2)
    with torch.no_grad():
        in_parts = model(*given)
    torch.testing.assert_close(in_parts, model(*given).detach(), rtol=1e-12, atol=1e-12)


def test_means_of_squares_are_those_of_their_pixels() -> None:
    both = torch.rand(1, 6, 9, 9, dtype=torch.float64)
    for width in (3, 7):
        half = width // 2
        found = _mean_around(both, width)
        for row, column in ((0, 0), (4, 4), (8, 3), (1, 8)):
            there = both[
                0,
                :,
                max(0, row - half) : row + half + 1,
                max(0, column - half) : column + half + 1,
            ]
            torch.testing.assert_close(found[0, :, row, column], there.mean(dim=(1, 2)))


def test_its_slopes_are_those_of_differences() -> None:
    told, light, albedo = (each.requires_grad_() for each in drawn_light(8, seed=3))
    model = awake_filter(3)
    weights = tuple(model.parameters())
    assert torch.autograd.gradcheck(
        lambda *_: model(told, light, albedo), (told, light, albedo, *weights), fast_mode=True
    )


@for_each("factor", [0.0, 1e-12, 1e6])
def test_extremes_stay_finite(factor: float) -> None:
    """In single precision, as it runs; pixels without albedo beside those with it."""
    told, light, albedo = (each.float() for each in drawn_light(16, seed=4))
    albedo[:, :8] = 0
    light[:, :8] = 0
    model = awake_filter(4).float()
    with torch.no_grad():
        for weight in model.alike.parameters():
            weight.mul_(1e3)  # so that no ray trusts another, nor itself
        mixed = model(1e3 * told, factor * light, albedo)
    assert mixed.isfinite().all()
    assert not mixed[:, :8].any(), "no specular albedo: nothing is mirrored"
    assert (factor == 0) == (not mixed.any())
    assert _MOST_DOUBT < 80, "e^-80 is near the smallest float"


@pytest.mark.slow("training")  # torch traces nine taps forth and back
def test_a_level_may_be_compiled() -> None:
    """As on a card; here by tracing alone, without a compiler."""
    torch._dynamo.reset()
    generator = torch.Generator().manual_seed(0)
    one = LightFilter(10, 8)
    given = [torch.randn(2, size, 16, 16, generator=generator) for size in (_ALIKE + 1, 6)]
    alike, both = (each.requires_grad_() for each in given)
    near = torch.randn(9, generator=generator)
    results: list[tuple[Tensor, ...]] = []
    for mixed in (one.mix_level, torch.compile(one.mix_level, backend="aot_eager")):
        alike.grad = both.grad = None
        shown = mixed(alike, near, both, 2)
        shown.square().mean().backward()
        assert alike.grad is not None and both.grad is not None
        results.append((shown.detach(), alike.grad, both.grad))
    for plain, compiled in zip(*results, strict=True):
        torch.testing.assert_close(compiled, plain, rtol=1e-4, atol=1e-6 * float(plain.abs().max()))


def test_a_plane_below_a_constant_sky_receives_its_radiance() -> None:
    """Irradiance over pi is the radiance: a sky all around, and half of it above."""
    floor = [quad(FLOOR, material(diffuse=0.5, specular=0.0))]
    sky = constant((0.5, 1.0, 2.0))
    scene = join(floor, eye=(0, 0.1, 3), target=(0, 0, 0), fov_deg=40, sky=sky)
    inputs = traced(scene, sky_rays=16)
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


def test_the_unit_is_the_mean_light_never_zero_and_a_sky_joins_it_and_what_triangles_receive() -> (
    None
):
    """Twice the light is twice the unit; without lamps the sky alone is the unit."""
    parts = [quad(FLOOR, material(diffuse=0.5)), light(LAMP, [8.0, 1e-3, 2.0])]
    mean_3 = scene_light(lit_scene(join(parts))).mean_3
    assert mean_3[0] > mean_3[2] > mean_3[1] > 0
    assert mean_3[1] == pytest.approx(0.03 * mean_3[0])
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
    gloss = gloss_at(lit, points)
    shift = np.random.default_rng(0).random((2, 4_000), np.float32)
    light = sky_light(lit, points, gloss, shift, slice(None), 0, rays=8, lobe_rays=0)
    alone = light.specular.mean(axis=1)
    shared = sky_light(lit, points, gloss, shift, slice(None), 0, rays=8, lobe_rays=1)
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
    """And the ends of the unit square are directions."""
    sky = SKIES[name]()
    drawn = SkySampler(sky)
    last = np.nextafter(np.float32(1), np.float32(0))
    ends = drawn.sample_directions(np.array([[0, 0, last, last], [0, last, 0, last]], np.float32))
    assert np.isfinite(ends).all()
    assert (drawn.pdf(ends) >= 0).all()
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


def test_a_sun_is_found_by_most_draws_which_turn_with_the_scene() -> None:
    u = np.random.default_rng(0).random((2, 1_000), np.float32)
    drawn = SkySampler(one_sun(1e6))
    assert np.mean(drawn.radiance(drawn.sample_directions(u)).max(axis=0) > 100) > 0.7
    there = SkySampler(smooth(rotation=TURN)).sample_directions(u)
    assert np.abs(TURN @ SkySampler(smooth()).sample_directions(u) - there).max() < 1e-6


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
    notes = NeuralRenderer(network).prepare(corner()).notes
    assert not any("environment" in note for note in notes)


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
