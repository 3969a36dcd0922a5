"""A metric of your own: the relative squared error by which denoisers are often compared.

    trilight evaluate CHECKPOINT --extend metric.py --data data/smoke --out judged

It stands in evaluation.md and evaluation.json beside the others, for the network and its rivals, by
template, triangles and lights, and against what the noise of the targets alone would score.
"""

import numpy as np

from trilight.extend import METRICS, JudgedPicture, Metric

DARK = 0.01
"""Added below the fraction, so that black pixels do not decide it."""


def relative_mse(picture: JudgedPicture) -> float:
    """Return the mean over pixels and channels of the squared error by the squared target."""
    difference = picture.radiance_rgb.astype(np.float64) - picture.target_rgb
    return float(np.mean(difference**2 / (picture.target_rgb.astype(np.float64) ** 2 + DARK)))


METRICS.register(
    "relative_mse",
    Metric(
        score=relative_mse,
        higher_is_better=False,
        meaning=f"mean of (a - b)^2 / (b^2 + {DARK}) of linear radiance, nothing clamped",
    ),
)
