"""How wrong a picture is, measured from its halves: held against pictures whose truth is known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.noise_floor import Half, measure_floor, squared_error, surprises
from storage.conventions import log10_radiance
from storage.metrics import MAX_DB, psnr_linear_db, psnr_log_db

PX = 32
NOISE = 0.05
EVERYWHERE = np.ones((PX, PX), bool)


def truth() -> NDArray[np.float32]:
    """Return a picture with stripes of one pixel, which a blur takes away."""
    stripes = 0.5 + 0.3 * (np.arange(PX) % 2)
    return np.broadcast_to(stripes[:, None, None], (PX, PX, 3)).astype(np.float32)


def blurred(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a denoiser's picture: means over three rows, with the same bias in any half."""
    mean = (np.roll(picture, 1, axis=0) + picture + np.roll(picture, -1, axis=0)) / 3
    return np.asarray(mean, np.float32)


def half(rng: np.random.Generator) -> Half:
    raw = truth() + rng.normal(scale=NOISE, size=(PX, PX, 3)).astype(np.float32)
    return Half(raw_rgb=raw, denoised_rgb=blurred(raw))


def linear(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    return radiance


def test_on_average_it_is_the_error_of_the_mean_of_both_halves() -> None:
    """In linear light the law is exact: stripes lose two thirds, of the noise a sixth remains."""
    rng = np.random.default_rng(0)
    estimates = [squared_error(half(rng), half(rng), linear).mean() for _ in range(200)]
    exact = (2 / 3 * 0.3) ** 2 + NOISE**2 / 6
    spread = np.std(estimates) / np.sqrt(len(estimates))
    assert abs(np.mean(estimates) - exact) < 4 * spread < 0.01 * exact


def test_in_a_curve_it_is_the_error_in_that_curve() -> None:
    rng = np.random.default_rng(1)
    pairs = [(half(rng), half(rng)) for _ in range(50)]
    found = np.mean([squared_error(a, b, log10_radiance).mean() for a, b in pairs])
    means = [0.5 * (a.denoised_rgb + b.denoised_rgb) for a, b in pairs]
    wanted = np.mean([10 ** (-psnr_log_db(mean, truth()) / 10) for mean in means])
    # The secant goes through the raw mean, whose noise of 0.035 bends it by some per cent.
    assert found == pytest.approx(wanted, rel=0.05)


def test_a_bias_that_both_halves_share_is_stated() -> None:
    rng = np.random.default_rng(2)
    flat = np.full((PX, PX, 3), truth().mean(), np.float32)
    a, b = (Half(raw_rgb=half(rng).raw_rgb, denoised_rgb=flat) for _ in range(2))
    assert psnr_log_db(a.denoised_rgb, b.denoised_rgb) == MAX_DB, "the halves agree exactly"
    floor = measure_floor(a, b, EVERYWHERE)
    # The allowances take off what one standard error and one pixel's surprise are: under 1 dB here.
    assert psnr_log_db(flat, truth()) - 1 < floor.log_db < psnr_log_db(flat, truth())
    assert psnr_linear_db(flat, truth()) - 1 < floor.linear_db < psnr_linear_db(flat, truth())


def test_rare_light_that_one_half_found_is_allowed_for() -> None:
    calm = truth()
    raw = calm.copy()
    raw[3, 4] = 20.0
    found, missed = (Half(raw_rgb=picture, denoised_rgb=calm) for picture in (raw, calm))
    mean = 0.5 * (raw[3, 4] + calm[3, 4])
    surprise = np.square(log10_radiance(mean) - log10_radiance(calm[3, 4])).mean()
    assert surprises(found, missed, log10_radiance).max() == pytest.approx(surprise)
    floor = measure_floor(found, missed, EVERYWHERE)
    # What one half alone has cancels in the estimate: the allowance is all that is stated.
    assert floor.log_db == pytest.approx(-10 * np.log10(surprise / PX**2), abs=0.1)
    both = measure_floor(found, found, EVERYWHERE)
    assert both.log_db < floor.log_db - 3, "light that both found is an error, and still a surprise"


def test_raw_halves_state_the_error_of_one() -> None:
    rng = np.random.default_rng(6)
    raw = [truth() + rng.normal(0, 0.02, (PX, PX, 3)).astype(np.float32) for _ in range(2)]
    halves = [Half(raw_rgb=picture, denoised_rgb=picture) for picture in raw]
    exact = psnr_log_db(raw[0], truth())
    # One standard error of 64 blocks more: 0.2 dB.
    assert measure_floor(halves[0], halves[1], EVERYWHERE).log_db == pytest.approx(exact, abs=0.4)


def test_halves_may_change_places() -> None:
    rng = np.random.default_rng(3)
    a, b = half(rng), half(rng)
    assert measure_floor(a, b, EVERYWHERE) == measure_floor(b, a, EVERYWHERE)


def test_pictures_without_error_or_without_geometry_state_the_cap() -> None:
    calm = Half(raw_rgb=truth(), denoised_rgb=truth())
    assert measure_floor(calm, calm, EVERYWHERE).log_db == MAX_DB
    rng = np.random.default_rng(4)
    assert measure_floor(half(rng), half(rng), ~EVERYWHERE).object_log_db == MAX_DB


def test_an_empty_background_earns_nothing() -> None:
    rng = np.random.default_rng(5)
    hits = np.zeros((2 * PX, 2 * PX), bool)
    hits[:PX, :PX] = True
    inner = (half(rng), half(rng))
    framed = (_framed(inner[0]), _framed(inner[1]))
    alone, floor = measure_floor(*inner, EVERYWHERE), measure_floor(*framed, hits)
    assert floor.object_log_db == pytest.approx(alone.log_db, abs=1e-9)
    assert floor.log_db > alone.log_db + 3, "three quarters of the pixels are exact"


def _framed(inner: Half) -> Half:
    wide = ((0, PX), (0, PX), (0, 0))
    return Half(raw_rgb=np.pad(inner.raw_rgb, wide), denoised_rgb=np.pad(inner.denoised_rgb, wide))
