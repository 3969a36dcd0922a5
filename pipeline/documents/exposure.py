"""How bright the pictures of a scene are on sheets and pages; what is stored keeps its radiance."""

import numpy as np
from numpy.typing import NDArray

_SEEN_PERCENT = 95
"""Of the pixels: so many are not white."""


def preview_gain(radiance_rgb: NDArray[np.float32]) -> np.float32:
    """Return the factor by which all pictures [..., 3] of a scene are shown darker; 1 for most.

    By `preview_srgb8` a radiance of 1 is white.
    """
    bright = float(np.percentile(radiance_rgb.max(axis=-1), _SEEN_PERCENT))
    return np.float32(1 / max(1.0, bright))
