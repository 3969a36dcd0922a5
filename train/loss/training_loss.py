"""Training loss: L1 on log10(1 + radiance), a perceptual term, and the weight of each view.

SSIM, structural similarity, is at one scale (Wang et al. 2004) and several (Wang et al. 2003).
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d

from storage.errors import TrilightError
from train.loss.lpips import LINEAR_FILE, VGG16_FILE, Lpips
from train.settings import LossSettings

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


class TrainingLoss(nn.Module):
    """Loss function of a run's settings."""

    def __init__(self, settings: LossSettings, lpips: Lpips | None) -> None:
        """Create the loss; `lpips` is needed only if the settings use it.

        Raises:
            TrilightError: the settings use LPIPS and its weights are missing; no other term
                replaces it silently.
        """
        super().__init__()
        self.settings = settings
        # a module among them becomes a part of this one, and moves with it
        self._dissimilarity = _dissimilarity(settings, lpips)

    def forward(
        self, prediction_BVRR3: Tensor, target_BVRR3: Tensor, noise_BV: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the losses of each view.

        Args:
            prediction_BVRR3: log10(1 + radiance) before the ELU, float32.
            target_BVRR3: log10(1 + radiance).
            noise_BV: root mean square noise of the targets in the same space.

        Returns:
            [B, V] weighted sums of all terms, which training minimizes, and the L1 terms alone,
            unweighted and detached from the gradient.
        """
        # Zeng et al. 2025, section 4, first term, but before the ELU, whose slope is a thousandth
        # for negative values: a network that once predicts below 0 would hardly come back. Targets
        # are at least 0, so the best prediction is the same.
        l1_BV = (prediction_BVRR3 - target_BVRR3).abs().mean(dim=(2, 3, 4))
        total_BV = l1_BV
        if self._dissimilarity is not None:
            pictures = [
                tone_map(log10_BVRR3).flatten(0, 1).movedim(-1, 1)
                for log10_BVRR3 in (prediction_BVRR3, target_BVRR3)
            ]
            unlike_BV = self._dissimilarity(*pictures).reshape(l1_BV.shape)
            total_BV = total_BV + self.settings.perceptual_weight * unlike_BV
        half = self.settings.noise_half
        if half:
            total_BV = total_BV * (half / (half + noise_BV))
        return total_BV, l1_BV.detach()


def _dissimilarity(
    settings: LossSettings, lpips: Lpips | None
) -> Callable[[Tensor, Tensor], Tensor] | None:
    if settings.perceptual == "none" or settings.perceptual_weight == 0:
        return None
    if settings.perceptual == "ms_ssim":
        return lambda a_M3RR, b_M3RR: 1 - ms_ssim(a_M3RR, b_M3RR)
    if lpips is None:
        raise TrilightError(
            f"loss.perceptual is lpips, but no weights were named; give --lpips FOLDER with "
            f"{VGG16_FILE} and {LINEAR_FILE}, --lpips hub to download them, or another term: "
            "--set loss.perceptual=ms_ssim or none."
        )
    return lpips


LOG10_OF_2 = math.log10(2.0)


def tone_map(log10_rgb: Tensor) -> Tensor:
    """Return log10(1 + radiance), any shape, as clamp(log2(1 + radiance), 0, 1).

    The tone map of everything perceptual (Zeng et al. 2025, section 4). Radiance above
    1 is white and has no gradient here; the L1 term sees it. `preview_srgb8` of
    storage.conventions is the same curve, sRGB-encoded for people.
    """
    return (log10_rgb / LOG10_OF_2).clamp(0.0, 1.0)
