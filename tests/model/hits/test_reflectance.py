"""Reflected, gathered and filtered light: beside closed forms and slow twins."""

import numpy as np
import pytest
import torch
from torch import Tensor

from model.hits.anchors import anchor_pixels
from model.hits.decoder import (
    _ALIKE,
    _MOST_DOUBT,
    STEPS_PX,
    TAPS,
    LightFilter,
    _mean_around,
)
from model.hits.lit_scene import Gloss, LitScene, Points, gloss_at, lobe, sample_lobe
from model.hits.radiosity import BOUNCES, scene_light
from model.hits.vectors import dot, unit
from model.hits.view_inputs import Channel
from storage.optics import directional_albedo
from tests.for_each import for_each
from tests.model.hits.kit import FLOOR, LAMP, corner, lit_scene, traced
from tests.pipeline.renders.sampling import lambert_irradiance
from tests.pipeline.renders.scene_kit import box, join, light, material, quad

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


def test_the_lobe_is_symmetric_but_for_its_scale() -> None:
    """D G2 / 4 / cosines: exchanging viewer and light changes nothing."""
    rng = np.random.default_rng(3)
    a, b = (unit(rng.normal(size=(3, 300)).astype(np.float32)) for _ in range(2))
    a[2], b[2] = np.abs(a[2]) + 0.05, np.abs(b[2]) + 0.05
    a, b = unit(a), unit(b)
    there = lobe(*_plate(0.5, a), b, b[2])[0] / b[2]
    back = lobe(*_plate(0.5, b), a, a[2])[0] / a[2]
    np.testing.assert_allclose(there, back, rtol=1e-3)


def test_from_behind_and_below_nothing_is_reflected() -> None:
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


def test_more_rays_less_noise_the_same_mean() -> None:
    few = [traced(corner(), gather_rays=8, seed=seed).gathered for seed in range(12)]
    many = [traced(corner(), gather_rays=128, seed=seed).gathered for seed in range(4)]
    error = np.std([x.mean() for x in few], ddof=1) / np.sqrt(len(few))
    assert abs(np.mean(few) - np.mean(many)) < 5 * error + 1e-3 * np.mean(many)
    assert np.std(many, axis=0).mean() < 0.6 * np.std(few, axis=0).mean()


def test_where_nothing_is_met_nothing_is_gathered() -> None:
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


def test_the_unit_is_the_mean_light_and_never_zero() -> None:
    lamps = [light(LAMP, [8.0, 1e-3, 2.0])]
    parts = [quad(FLOOR, material(diffuse=0.5)), *lamps]
    unit = scene_light(lit_scene(join(parts))).mean_3
    assert unit[0] > unit[2] > unit[1] > 0
    assert unit[1] == pytest.approx(0.03 * unit[0])


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


def test_even_light_stays_what_it_is_whatever_the_pattern() -> None:
    told, _, albedo = drawn_light(24)
    with torch.no_grad():
        mixed = awake_filter()(told, 3.0 * albedo, albedo)
    torch.testing.assert_close(mixed, 3.0 * albedo, rtol=1e-12, atol=1e-12)


def test_no_light_is_made_and_none_is_negative() -> None:
    """A mixture of light without albedo lies between the least and the most of its colour."""
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
