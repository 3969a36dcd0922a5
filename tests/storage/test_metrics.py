"""Metrics against values known on paper."""

import numpy as np
import pytest

from storage.metrics import MAX_DB, object_psnr_log_db, psnr_linear_db, psnr_log_db


def test_a_decade_apart_is_zero_db() -> None:
    assert psnr_log_db(np.full((4, 4, 3), 9.0), np.full((4, 4, 3), 99.0)) == pytest.approx(0)


def test_a_tenth_of_a_decade_is_twenty_db() -> None:
    picture = np.random.default_rng(0).random((8, 8, 3)) * 10
    brighter = (1 + picture) * 10**0.1 - 1
    assert psnr_log_db(picture, brighter) == pytest.approx(20)


def test_linear_sees_nothing_above_one() -> None:
    # Twelve and seven: one side clamped elsewhere would still pass with a value of 1 on the other.
    assert psnr_linear_db(np.full(9, 12.0), np.full(9, 7.0)) == MAX_DB
    assert psnr_linear_db(np.full(9, 0.5), np.full(9, 0.6)) == pytest.approx(20)


def test_equal_pictures_are_capped() -> None:
    picture = np.ones((2, 2, 3))
    assert psnr_log_db(picture, picture) == MAX_DB


def test_background_earns_nothing() -> None:
    hits = np.zeros((10, 10), bool)
    hits[0, 0] = True
    a, b = np.zeros((10, 10, 3)), np.zeros((10, 10, 3))
    b[0, 0] = 9
    assert object_psnr_log_db(a, b, hits) == pytest.approx(0)
    assert psnr_log_db(a, b) == pytest.approx(20)  # a hundredth of the pixels: 20 dB for nothing


def test_symmetry() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 6, 6, 3)) * 100
    assert psnr_log_db(a, b) == psnr_log_db(b, a)
    assert psnr_linear_db(a, b) == psnr_linear_db(b, a)
