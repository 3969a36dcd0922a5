"""Every figure that one picture is judged by, with what each of them is."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.precision import tf32
from storage.conventions import log10_radiance
from train.evaluation.scores import score_view
from train.loss.lpips import Lpips
from train.loss.ms_ssim import ssim
from train.loss.tone_map import tone_mapped

HIGHER_IS_BETTER = {
    "psnr_log_db": True,
    "object_psnr_log_db": True,
    "psnr_linear_db": True,
    "ssim": True,
    "lpips": False,
    "hdr_flip": False,
    "log_l1": False,
}
"""Every metric, in the order of reports."""

MEANING = {
    "psnr_log_db": "PSNR of log10(1 + radiance), peak 1, nothing clamped (storage.metrics)",
    "object_psnr_log_db": "the same over pixels whose ray meets geometry",
    "psnr_linear_db": "PSNR of radiance clamped to [0, 1], peak 1; for published figures only",
    "ssim": "SSIM of clamp(log2(1 + radiance), 0, 1), Gaussian windows of 11 pixels (Wang 2004)",
    "lpips": "LPIPS 0.1 on VGG16 of the same tone map, with the published weights",
    "hdr_flip": "mean HDR-FLIP of radiance (flip-evaluator, 67 pixels per degree, ACES)",
    "log_l1": "mean absolute error of log10(1 + radiance), after the output's ELU",
}
"""Tone map, range and library of each."""

DECIMALS = {name: 2 if name.endswith("_db") else 4 for name in MEANING}
"""With which each is printed."""


def picture_scores(
    radiance_rgb: NDArray, target_rgb: NDArray, hits: NDArray[np.bool_], lpips: Lpips | None
) -> dict[str, float | None]:
    """Return every metric of one picture [R, R, 3] of linear radiance; None stands for n/a.

    LPIPS is n/a without its weights, HDR-FLIP where the target is black all over, since it takes
    its exposures from there.
    """
    score = score_view(radiance_rgb, target_rgb, hits)
    ours_13RR, target_13RR = (_tone_mapped(picture) for picture in (radiance_rgb, target_rgb))
    return {
        "psnr_log_db": score.psnr_log_db,
        "object_psnr_log_db": score.object_psnr_log_db,
        "psnr_linear_db": score.psnr_linear_db,
        "ssim": float(ssim(ours_13RR, target_13RR)),
        "lpips": None if lpips is None else _distance(lpips, ours_13RR, target_13RR),
        "hdr_flip": hdr_flip(radiance_rgb, target_rgb),
        "log_l1": score.log_l1,
    }


def hdr_flip(radiance_rgb: NDArray, target_rgb: NDArray) -> float | None:
    """Return the mean HDR-FLIP (Andersson et al. 2021), or None for a black target."""
    import flip_evaluator  # native code, half a second to import

    if not target_rgb.max() > 0:
        return None
    pictures = [np.ascontiguousarray(p, np.float32) for p in (target_rgb, radiance_rgb)]
    _, mean, _ = flip_evaluator.evaluate(*pictures, "HDR", applyMagma=False)
    return float(mean)


@torch.no_grad()
def _distance(lpips: Lpips, a_13RR: Tensor, b_13RR: Tensor) -> float:
    """Return LPIPS, computed where its weights are; in all bits of float32, as it was published."""
    device = lpips.shift_311.device
    with tf32(False):
        return float(lpips(a_13RR.float().to(device), b_13RR.float().to(device)))


def _tone_mapped(radiance_rgb: NDArray) -> Tensor:
    log10 = torch.from_numpy(np.ascontiguousarray(log10_radiance(radiance_rgb), np.float64))
    return tone_mapped(log10).movedim(-1, 0)[None]
