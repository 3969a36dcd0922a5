"""Error pictures in false color; imports no torch."""

import numpy as np
from numpy.typing import NDArray

from storage.conventions import log10_radiance

ERROR_WHITE = 0.5
"""|log10(1 + a) - log10(1 + b)| that the error picture shows as white."""


def error_picture(predicted_rgb: NDArray, target_rgb: NDArray) -> NDArray[np.uint8]:
    """Return the error of log10(1 + radiance) [R, R, 3], from black over red to white."""
    return heat_colors(mean_error(predicted_rgb, target_rgb) / ERROR_WHITE)


def mean_error(predicted_rgb: NDArray, target_rgb: NDArray) -> NDArray:
    """Return |log10(1 + a) - log10(1 + b)| [R, R], averaged over channels."""
    error: NDArray = np.abs(log10_radiance(predicted_rgb) - log10_radiance(target_rgb))
    return error.mean(axis=-1)


def heat_colors(level_RR: NDArray) -> NDArray[np.uint8]:
    """Map 0 to 1 to black, red, yellow and white."""
    ramp = np.clip(3 * level_RR[..., None] - np.array([0, 1, 2]), 0, 1)
    return np.round(255 * ramp).astype(np.uint8)
