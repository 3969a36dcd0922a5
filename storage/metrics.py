"""Image metrics (PSNR and others) of two pictures: the only definitions.

Values in dB never stand alone: report the median, the 5th percentile and the share over a target.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from storage.conventions import log10_radiance

MAX_DB = 100.0
"""Reported for pictures that agree exactly, so that means and plots stay finite."""

SEAM_TILES = 16
"""Tiles a side between which `seam` looks: the anchors of the included network."""


def psnr_log_db(a: ArrayLike, b: ArrayLike) -> float:
    """Return -10 log10 mean((log10(1+a) - log10(1+b))^2), capped at MAX_DB.

    Both are linear radiance of at least 0, of one shape. The error is taken in the space of the
    network's output with peak 1, and nothing is clamped. "Noise floor" always means this one. For
    scale: 36 dB linear is about 46 dB here.
    """
    return _db(_squared_log_error(a, b))


def psnr_linear_db(a: ArrayLike, b: ArrayLike) -> float:
    """Return the PSNR of linear radiance clamped to [0, 1] with peak 1, capped at MAX_DB.

    Only for comparison with published figures: it sees nothing above radiance 1.
    """
    clamped_a = np.clip(np.asarray(a, np.float64), 0, 1)
    clamped_b = np.clip(np.asarray(b, np.float64), 0, 1)
    return _db(np.square(clamped_a - clamped_b))


def object_psnr_log_db(a: ArrayLike, b: ArrayLike, hits: NDArray[np.bool_]) -> float:
    """Return psnr_log_db over the pixels whose camera ray hits geometry.

    Empty background earns nothing here. A picture without any hit scores MAX_DB.

    Args:
        a: [R, R, 3] linear radiance.
        b: the same shape.
        hits: [R, R] whether the pixel's ray hits geometry.
    """
    return _db(_squared_log_error(a, b)[hits])


def flicker_log_db(before: ArrayLike, now: ArrayLike) -> float:
    """Return how calm an error is from one frame to the next, capped at MAX_DB; higher is calmer.

    -10 log10 mean((E2 - E1)^2) of the errors E of two frames in a row: log10(1 + radiance) less
    that of the truth, any shape. What the frames themselves show of motion is in both pictures of a
    frame, hence not in E. Errors that have nothing to do with each other from frame to frame
    flicker 3 dB worse than they err.
    """
    return _db(np.square(np.asarray(now, np.float64) - np.asarray(before, np.float64)))


def pepper(a: ArrayLike, b: ArrayLike) -> float:
    """Return how much more a picture varies between neighboring pixels than its reference.

    The mean, over squares of three by three pixels, of sqrt(max(0, var_a - var_b)) of log10(1 +
    radiance). Noise raises it; a smooth or a blurred error does not. Both are [R, R, 3] linear
    radiance with R of at least 3; `b` is without noise.
    """
    of_a, of_b = (
        sliding_window_view(_log(each), (3, 3), axis=(0, 1)).var(axis=(-2, -1)) for each in (a, b)
    )
    return float(np.sqrt(np.maximum(of_a - of_b, 0)).mean())


def seam(a: ArrayLike, b: ArrayLike) -> float:
    """Return how much steeper an error is between tiles of a picture than inside them; 1 is equal.

    The mean absolute difference of the error of log10(1 + radiance) from a pixel to the next, where
    two of SEAM_TILES tiles a side meet, over that elsewhere. A picture without error has 1. Both
    are [R, R, 3] linear radiance with R of at least 3; tiles have two pixels or more.
    """
    error = _log(a) - _log(b)
    step = max(2, len(error) // math.gcd(len(error), SEAM_TILES))
    is_between = np.arange(1, len(error)) % step == 0
    steps = np.stack(
        [np.abs(np.diff(each, axis=0)).mean(axis=(1, 2)) for each in (error, error.swapaxes(0, 1))]
    )
    inside = steps[:, ~is_between].mean()
    return float(steps[:, is_between].mean() / inside) if inside > 0 else 1.0


def mean_interval(figures: Sequence[float], clusters: Sequence[str]) -> tuple[float, float]:
    """Return the 95 % interval of a mean whose figures are alike within clusters.

    It is bootstrapped over whole clusters (2000 times, of a fixed seed).

    Args:
        figures: one for each turn.
        clusters: the name of each turn's cluster.
    """
    names = sorted(set(clusters))
    rows = np.array([names.index(name) for name in clusters])
    sums = np.bincount(rows, weights=np.asarray(figures, np.float64))
    counts = np.bincount(rows)
    drawn = np.random.default_rng(0).integers(len(names), size=(2000, len(names)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def _log(radiance_rgb: ArrayLike) -> NDArray[np.float64]:
    return log10_radiance(np.asarray(radiance_rgb, np.float64))


def _squared_log_error(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    return np.square(_log(a) - _log(b))


def _db(squared_error: NDArray[np.float64]) -> float:
    mean = float(squared_error.mean()) if squared_error.size else 0.0
    return MAX_DB if mean <= 10 ** (-MAX_DB / 10) else float(-10 * np.log10(mean))
