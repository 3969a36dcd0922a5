"""Training loss: L1 on log10(1 + radiance), a perceptual term, and the weight of each view."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor, nn

from storage.errors import TrilightError
from train.loss.lpips import LINEAR_FILE, VGG16_FILE, Lpips
from train.loss.ms_ssim import ms_ssim
from train.settings import LossSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewLosses:
    """Losses of the views of a batch."""

    total_BV: Tensor
    """Weighted sum of all terms per view, which training minimizes."""
    l1_BV: Tensor
    """L1 term alone, unweighted and detached from the gradient."""


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
    ) -> ViewLosses:
        """Return the losses of each view.

        Args:
            prediction_BVRR3: log10(1 + radiance) before the ELU, float32.
            target_BVRR3: log10(1 + radiance).
            noise_BV: root mean square noise of the targets in the same space.
        """
        l1_BV = view_l1(prediction_BVRR3, target_BVRR3)
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
        return ViewLosses(total_BV=total_BV, l1_BV=l1_BV.detach())


def view_l1(prediction_BVRR3: Tensor, target_BVRR3: Tensor) -> Tensor:
    """Return the L1 error [B, V] of log10(1 + radiance), before the output's ELU.

    Zeng et al. 2025, section 4, first term. Before the ELU because its slope is a thousandth for
    negative values: a network that once predicts below 0 would hardly come back. Targets are at
    least 0, so the best prediction is the same.
    """
    return (prediction_BVRR3 - target_BVRR3).abs().mean(dim=(2, 3, 4))


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
