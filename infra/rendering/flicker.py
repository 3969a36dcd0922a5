"""How much of a network's error changes from one frame to the next.

An error that stays where it is on the screen is hardly seen in motion; one that jumps is. With E
the error of log10(1 + radiance) of a frame, flicker is the root mean square of the difference of E
between two frames in a row, as a PSNR of peak 1. Errors that have nothing to do with each other
from frame to frame flicker 3 dB worse than they err.
"""

import numpy as np
from numpy.typing import NDArray

from storage.conventions import log10_radiance


def log_error(neural_rgb: NDArray[np.float32], traced_rgb: NDArray[np.float32]) -> NDArray:
    """Return the error [R, R, 3] of log10(1 + radiance)."""
    error: NDArray = log10_radiance(neural_rgb) - log10_radiance(traced_rgb)
    return error


def flicker_db(before_RR3: NDArray, now_RR3: NDArray) -> float:
    """Return the flicker between two frames with these errors; 100 dB at most, higher is calmer."""
    return _db(float(np.mean((now_RR3 - before_RR3) ** 2, dtype=np.float64)))


def noise_flicker_db(before_floor_db: float, now_floor_db: float) -> float:
    """Return what the noise of two traced frames would flicker: the most that can be measured."""
    return _db(10 ** (-before_floor_db / 10) + 10 ** (-now_floor_db / 10))


def _db(mean_square: float) -> float:
    return float(-10 * np.log10(max(mean_square, 1e-10)))
