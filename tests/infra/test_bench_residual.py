"""The account of what lies between two renderers, on pictures whose parts are known."""

from pathlib import Path

import numpy as np
import pytest

from infra.bench.cycles.residual import Pictures, account, draw
from storage.metrics import MAX_DB

_SIZE = 128
_OUR_STD, _THEIR_STD, _BIAS = 0.01, 0.02, 0.03


def _noisy(truth: np.ndarray, std: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(scale=std, size=truth.shape)
    return (truth + noise).astype(np.float32)


def test_noise_and_bias_are_told_apart() -> None:
    truth = np.full((_SIZE, _SIZE, 3), 0.5)
    ours = (_noisy(truth, _OUR_STD, 1), _noisy(truth, _OUR_STD, 2))
    cycles = (_noisy(truth + _BIAS, _THEIR_STD, 3), _noisy(truth + _BIAS, _THEIR_STD, 4))
    found = account(ours, cycles)
    # 49,152 values: a mean square is known to 0.6 %, 0.03 dB; three of them make the rest
    assert found.our_noise_db == pytest.approx(-20 * np.log10(_OUR_STD), abs=0.1)
    assert found.cycles_noise_db == pytest.approx(-20 * np.log10(_THEIR_STD), abs=0.1)
    assert found.rest_db == pytest.approx(-20 * np.log10(_BIAS), abs=0.15)
    assert found.rest_blocks_db == pytest.approx(-20 * np.log10(_BIAS), abs=0.15)
    assert found.mean_ratio == pytest.approx(0.5 / (0.5 + _BIAS), abs=1e-3)


def test_noise_alone_leaves_little() -> None:
    truth = np.full((_SIZE, _SIZE, 3), 0.5)
    found = account(
        (_noisy(truth, 0.02, 1), _noisy(truth, 0.02, 2)),
        (_noisy(truth, 0.02, 3), _noisy(truth, 0.02, 4)),
    )
    # what is left is the chance of 49,152 values: below 2 % of the noise, 17 dB under it
    assert found.rest_db > found.our_noise_db + 17
    assert found.rest_db <= MAX_DB


def test_a_glint_is_in_the_worst_pixels() -> None:
    even = np.full((_SIZE, _SIZE, 3), 0.5, dtype=np.float32)
    glint = even.copy()
    glint[3, 5] = 7.0
    found = account((glint, glint), (even, even))
    assert found.worst_share == 1.0
    # clamped to 1, hence off by a half: one pixel of 16,384; exact in these numbers
    assert found.between_db == pytest.approx(10 * np.log10(4 * _SIZE**2), abs=1e-6)


def test_the_pictures_are_drawn(tmp_path: Path) -> None:
    even = np.full((16, 16, 3), 0.5, dtype=np.float32)
    made = Pictures(name="made", ours=(even, even), cycles=(even, even))
    draw([made, made], tmp_path / "residual.png")
    assert (tmp_path / "residual.png").stat().st_size > 10_000  # an empty page has fewer
