"""How wrong a picture is, measured from its halves."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.noise_floor import Half, common_error_db, measure_floor, outlying_share
from storage.metrics import MAX_DB, psnr_log_db

SPP = 128


def calm(picture: NDArray[np.float32]) -> Half:
    """Return a half whose denoiser had nothing to do."""
    return Half(raw_rgb=picture, denoised_rgb=picture)


def test_without_outliers_the_floor_is_the_agreement_of_the_halves() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(size=(8, 8, 3)).astype(np.float32)
    b = a + rng.normal(scale=0.01, size=a.shape).astype(np.float32).clip(-a, None)
    everywhere = np.ones((8, 8), bool)
    floor = measure_floor(calm(a), calm(b), everywhere, SPP)
    assert floor == measure_floor(calm(b), calm(a), everywhere, SPP)
    assert floor.log_db == psnr_log_db(a, b)
    assert floor.object_log_db == floor.log_db
    assert measure_floor(calm(a), calm(a), everywhere, SPP).log_db == MAX_DB


def test_light_that_the_denoiser_took_away_lowers_the_floor() -> None:
    smooth = np.full((8, 8, 3), 0.5, np.float32)
    raw = smooth.copy()
    raw[3, 4] = 20.0
    half = Half(raw_rgb=raw, denoised_rgb=smooth)
    # one pixel stands out by 20 - 4 x 0.5; all light is 63 x 0.5 + 20
    assert outlying_share(half, half) == pytest.approx(18 / 51.5)
    everywhere = np.ones((8, 8), bool)
    assert measure_floor(half, half, everywhere, SPP).log_db == MAX_DB - 4


def test_what_is_taken_off_grows_with_outliers_and_with_fewer_samples() -> None:
    assert common_error_db(0.0, 32) == common_error_db(0.005, 32) == 0
    assert common_error_db(0.05, 128) == pytest.approx(3.0)
    assert common_error_db(0.05, 4096) == pytest.approx(3.0)
    assert common_error_db(0.05, 64) == pytest.approx(6.0)
    assert common_error_db(0.05, 32) == pytest.approx(9.0)
    assert common_error_db(1.0, 128) == 4.0


def test_a_black_picture_has_no_outliers() -> None:
    black = np.zeros((8, 8, 3), np.float32)
    assert outlying_share(calm(black), calm(black)) == 0


def test_an_empty_background_earns_nothing() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.uniform(size=(2, 8, 8, 3)).astype(np.float32)
    hits = np.zeros((8, 8), bool)
    hits[:4] = True
    a[4:] = b[4:] = 0
    floor = measure_floor(calm(a), calm(b), hits, SPP)
    # Half of the pixels agree exactly: the mean over all is 10 log10 2 dB better.
    np.testing.assert_allclose(floor.log_db - floor.object_log_db, 10 * np.log10(2))
