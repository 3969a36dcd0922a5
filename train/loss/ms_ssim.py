"""SSIM, structural similarity, at one scale (Wang et al. 2004) and several (Wang et al. 2003)."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from storage.errors import TrilightError

WINDOW_PX = 11
SIGMA_PX = 1.5
K1 = 0.01
K2 = 0.03
"""Constants of both papers, for pictures in [0, 1]."""

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponent of each scale, finest first; with fewer scales they are brought to a sum of 1."""

MIN_STRUCTURE = 1e-4
"""Lower bound of a scale's mean, since a power of a negative number has no gradient."""


def ssim(a_M3RR: Tensor, b_M3RR: Tensor) -> Tensor:
    """Return the SSIM [M] of pictures in [0, 1]: Gaussian windows that lie within the picture.

    Equal to scikit-image's with gaussian_weights, sigma 1.5, use_sample_covariance off and the
    border left out, up to rounding.

    Raises:
        TrilightError: pictures below 11 pixels.
    """
    luminance, structure = _luminance_and_structure(a_M3RR, b_M3RR)
    return (luminance * structure).mean(dim=(1, 2, 3))


def ms_ssim(a_M3RR: Tensor, b_M3RR: Tensor) -> Tensor:
    """Return the multi-scale SSIM [M] of pictures in [0, 1].

    It uses as many of the five scales as are at least a window wide: 5 from 176 pixels, 3 at 64.

    Raises:
        TrilightError: pictures below 11 pixels.
    """
    scales = 1
    while scales < len(SCALE_WEIGHTS) and a_M3RR.shape[-1] >> scales >= WINDOW_PX:
        scales += 1
    weights = [weight / sum(SCALE_WEIGHTS[:scales]) for weight in SCALE_WEIGHTS[:scales]]
    product_M = a_M3RR.new_ones(len(a_M3RR))
    for scale, weight in enumerate(weights):
        luminance, structure = _luminance_and_structure(a_M3RR, b_M3RR)
        part = luminance * structure if scale == scales - 1 else structure
        product_M = product_M * part.mean(dim=(1, 2, 3)).clamp(min=MIN_STRUCTURE) ** weight
        a_M3RR = avg_pool2d(a_M3RR, 2)
        b_M3RR = avg_pool2d(b_M3RR, 2)
    return product_M


def _luminance_and_structure(a_M3RR: Tensor, b_M3RR: Tensor) -> tuple[Tensor, Tensor]:
    """Return luminance and contrast-structure of every window (2004, equations 6 and 13)."""
    if a_M3RR.shape[-1] < WINDOW_PX:
        raise TrilightError(
            f"SSIM: pictures of {a_M3RR.shape[-1]} pixels; expected at least {WINDOW_PX}, the "
            "width of its window."
        )
    mean_a = _blur(a_M3RR)
    mean_b = _blur(b_M3RR)
    var_a = _blur(a_M3RR.square()) - mean_a.square()
    var_b = _blur(b_M3RR.square()) - mean_b.square()
    covariance = _blur(a_M3RR * b_M3RR) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + K1**2) / (mean_a.square() + mean_b.square() + K1**2)
    structure = (2 * covariance + K2**2) / (var_a + var_b + K2**2)
    return luminance, structure


def _blur(x_M3RR: Tensor) -> Tensor:
    """Return the Gaussian means of windows that lie within the picture."""
    offset = torch.arange(WINDOW_PX, dtype=x_M3RR.dtype, device=x_M3RR.device) - WINDOW_PX // 2
    weight = torch.exp(-0.5 * (offset / SIGMA_PX) ** 2)
    kernel = (weight / weight.sum()).expand(3, 1, 1, -1)
    rows = conv2d(x_M3RR, kernel, groups=3)
    return conv2d(rows, kernel.transpose(2, 3), groups=3)
