"""What the noise of a target alone would score: no picture can be asked for more.

The stored floors are measured, at the resolution that is stored; fewer pixels have less noise, so
that at a lower resolution they ask for a little less than could be asked. For metrics in which no
noise was measured, the target is judged with noise of the stored size drawn onto it. What is left
behind a denoiser is smoother than such independent noise: these floors are a model.
"""

import numpy as np
from numpy.typing import NDArray

from storage.conventions import log10_radiance, radiance_from_log10
from storage.records.sample import ViewRecord
from train.evaluation.metrics import METRICS, JudgedPicture, noise_rms
from train.loss.lpips import Lpips


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
        lpips: as in metrics.picture_scores.
        rng: draws the noise.
    """
    noisy = log10_radiance(target_rgb) + rng.normal(0, noise_rms(view), target_rgb.shape)
    twin = JudgedPicture(
        radiance_rgb=radiance_from_log10(np.maximum(noisy, 0)),
        target_rgb=target_rgb,
        hits=hits,
        lpips=lpips,
    )
    found = {
        name: metric.floor(view) if metric.floor else metric.score(twin)
        for name, metric in METRICS.items()
    }
    return {name: floor for name, floor in found.items() if floor is not None}
