"""The filter of mirrored light: what it keeps, where it ends, and a slow twin of a level."""

import pytest
import torch
from torch import Tensor

from model.hits.light_filter import (
    _ALIKE,
    _MOST_DOUBT,
    STEPS_PX,
    TAPS,
    LightFilter,
    _mean_around,
    _mixed,
)
from tests.for_each import for_each

TOLD = 5


def awake_filter(seed: int = 0, size: float = 0.5) -> LightFilter:
    """Return a filter none of whose parts is zero; the smaller its weights, the more it mixes."""
    generator = torch.Generator().manual_seed(seed)
    found = LightFilter(TOLD, 16).double()
    with torch.no_grad():
        for weight in found.parameters():
            weight.copy_(size * torch.randn(weight.shape, generator=generator))
    return found


def drawn(px: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Return what pixels are told, their light and their specular albedo."""
    generator = torch.Generator().manual_seed(seed)
    told = torch.randn(1, px, px, TOLD, generator=generator, dtype=torch.float64)
    albedo = torch.rand(1, px, px, 3, generator=generator, dtype=torch.float64)
    light = albedo * torch.rand(1, px, px, 3, generator=generator, dtype=torch.float64).exp()
    return told, light, albedo


def test_even_light_stays_what_it_is_whatever_the_pattern() -> None:
    told, _, albedo = drawn(24)
    with torch.no_grad():
        mixed = awake_filter()(told, 3.0 * albedo, albedo)
    torch.testing.assert_close(mixed, 3.0 * albedo, rtol=1e-12, atol=1e-12)


def test_no_light_is_made_and_none_is_negative() -> None:
    """A mixture of light without albedo lies between the least and the most of its colour."""
    told, light, albedo = drawn(32, seed=1)
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
    torch.testing.assert_close(_mixed(alike, near, both, step), expected)
    with torch.inference_mode():  # by rows, in parts
        torch.testing.assert_close(_mixed(alike, near, both, step), expected)


@for_each("px", [8, 40, 72])
def test_pictures_are_the_same_in_parts_and_whole(px: int) -> None:
    given, model = drawn(px, seed=2), awake_filter(2)
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
    told, light, albedo = (each.requires_grad_() for each in drawn(8, seed=3))
    model = awake_filter(3)
    weights = tuple(model.parameters())
    assert torch.autograd.gradcheck(
        lambda *_: model(told, light, albedo), (told, light, albedo, *weights), fast_mode=True
    )


@for_each("factor", [0.0, 1e-12, 1e6])
def test_extremes_stay_finite(factor: float) -> None:
    """In single precision, as it runs; pixels without albedo beside those with it."""
    told, light, albedo = (each.float() for each in drawn(16, seed=4))
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
    for mixed in (one.mixed, torch.compile(one.mixed, backend="aot_eager")):
        alike.grad = both.grad = None
        shown = mixed(alike, near, both, 2)
        shown.square().mean().backward()
        assert alike.grad is not None and both.grad is not None
        results.append((shown.detach(), alike.grad, both.grad))
    for plain, compiled in zip(*results, strict=True):
        torch.testing.assert_close(compiled, plain, rtol=1e-4, atol=1e-6 * float(plain.abs().max()))
