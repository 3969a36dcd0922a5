"""Judging by raw halves: errors come out right however noisy the halves are."""

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.bench.workloads.judged_pictures import difference_db
from infra.rendering.raw_references import RawReference, true_error_db
from pipeline.renders.noise_floor import clamped_radiance
from storage.conventions import log10_radiance
from storage.metrics import psnr_linear_db, psnr_log_db

PX = 64
EVERYWHERE = np.ones((PX, PX), bool)


def _truth() -> NDArray[np.float64]:
    return np.linspace(0.05, 0.9, PX * PX * 3).reshape(PX, PX, 3)


def _noisy(rng: np.random.Generator, spread: float) -> NDArray[np.float64]:
    return _truth() + rng.normal(0, spread, (PX, PX, 3))


def test_noise_of_the_reference_does_not_count() -> None:
    """Halves with three times the picture's error: 12,288 values leave 0.4 dB open, here thrice."""
    rng = np.random.default_rng(0)
    picture = (_truth() + rng.normal(0, 0.01, (PX, PX, 3))).astype(np.float32)
    halves = RawReference(a_rgb=_noisy(rng, 0.03), b_rgb=_noisy(rng, 0.03))
    for curve, metric in ((log10_radiance, psnr_log_db), (clamped_radiance, psnr_linear_db)):
        exact = metric(picture, _truth().astype(np.float32))
        found, open_db = true_error_db(picture, halves, curve, EVERYWHERE)
        assert found == pytest.approx(exact, abs=1.3)
        assert 0.2 < open_db < 0.8, "and it says how much that is"
        plain = metric(picture, (0.5 * (halves.a_rgb + halves.b_rgb)).astype(np.float32))
        assert plain < exact - 5, "the mean of the halves would have hidden the picture's error"


def test_two_renderers_without_noise() -> None:
    rng = np.random.default_rng(1)
    one, other = (
        RawReference(a_rgb=factor * _noisy(rng, 0.05), b_rgb=factor * _noisy(rng, 0.05))
        for factor in (1.0, 1.1)
    )
    apart = log10_radiance(_truth()) - log10_radiance(1.1 * _truth())
    exact = -10 * np.log10(np.square(apart).mean())
    assert difference_db(one, other, log10_radiance) == pytest.approx(exact, abs=0.5)
    same = RawReference(a_rgb=_noisy(rng, 0.05), b_rgb=_noisy(rng, 0.05))
    assert difference_db(one, same, log10_radiance) > exact + 8
