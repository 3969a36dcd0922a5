"""What the noise of a target alone would score: no picture can be asked for more.

The stored floors are measured, at the resolution that is stored; fewer pixels have less noise, so
that at a lower resolution they ask for a little less than could be asked. For metrics in which no
noise was measured, the target is judged with noise of the stored size drawn onto it. What is left
behind a denoiser is smoother than such independent noise: these floors are a model.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.conventions import log10_radiance, radiance_from_log10
from storage.sample import ViewRecord
from train.evaluation.picture_scores import picture_scores
from train.loss.lpips import Lpips

DRAWN = ("ssim", "lpips", "hdr_flip")
"""Metrics whose floors are of drawn noise."""


def noise_floors(
    view: ViewRecord,
    target_rgb: NDArray,
    hits: NDArray[np.bool_],
    lpips: Lpips | None,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Return the floor of every metric that has one; LPIPS has none without its weights.

    For log_l1 it is an upper bound, since a mean absolute error is at most the root mean square.

    Args:
        view: what is stored of the view.
        target_rgb: [R, R, 3] linear radiance, as it is judged.
        hits: [R, R] which pixels see geometry.
        lpips: as in picture_scores.
        rng: draws the noise.
    """
    rms = 10 ** (-view.noise_floor_db / 20)
    noisy = log10_radiance(target_rgb) + rng.normal(0, rms, target_rgb.shape)
    twin = picture_scores(radiance_from_log10(np.maximum(noisy, 0)), target_rgb, hits, lpips)
    measured: dict[str, Any] = {
        "psnr_log_db": view.noise_floor_db,
        "object_psnr_log_db": view.object_noise_floor_db,
        "psnr_linear_db": view.noise_floor_linear_db,
        "log_l1": rms,
    }
    return measured | {name: twin[name] for name in DRAWN if twin[name] is not None}
