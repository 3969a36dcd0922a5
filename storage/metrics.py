"""Distances between two pictures: the only definitions.

Values in dB never stand alone: report the median, the 5th percentile and the share over a target.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import log10_radiance

MAX_DB = 100.0
"""Reported for pictures that agree exactly, so that means and plots stay finite."""


def psnr_log_db(a: ArrayLike, b: ArrayLike) -> float:
    """Return -10 log10 mean((log10(1+a) - log10(1+b))^2), capped at MAX_DB.

    The error is taken in the space of the network's output with peak 1, and nothing is clamped.
    "Noise floor" always means this one. For scale: 36 dB linear is about 46 dB here.

    Args:
        a: linear radiance of at least 0, any shape.
        b: the same shape.
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

    -10 log10 mean((E2 - E1)^2) of the errors E of log10(1 + radiance) of two frames in a row. What
    the frames themselves show of motion is in both pictures of a frame, hence not in E. Errors that
    have nothing to do with each other from frame to frame flicker 3 dB worse than they err.

    Args:
        before: log10(1 + radiance) of the frame before less that of its truth, any shape.
        now: the same of this frame.
    """
    return _db(np.square(np.asarray(now, np.float64) - np.asarray(before, np.float64)))


def _squared_log_error(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    difference = log10_radiance(np.asarray(a, np.float64)) - log10_radiance(
        np.asarray(b, np.float64)
    )
    return np.square(difference)


def _db(squared_error: NDArray[np.float64]) -> float:
    mean = float(squared_error.mean()) if squared_error.size else 0.0
    return MAX_DB if mean <= 10 ** (-MAX_DB / 10) else float(-10 * np.log10(mean))
