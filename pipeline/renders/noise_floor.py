"""Stated error of a picture by the variance between its halves, without a reference.

The samples of a picture are two halves A and B that share nothing. Let T be the truth, x = A - T
and y = B - T their noise, and a, b the errors of the two halves once they are denoised:
D(A) = T + a and D(B) = T + b. In every pixel

    1/2 [(D(A) - B)^2 + (D(B) - A)^2] - 1/2 (A - B)^2  =  1/2 (a^2 + b^2) - a y - b x + x y.

The noises are independent and have mean zero; a depends on A alone, and b on B alone. On average
the last three terms vanish, and what remains is the squared error of a denoised half, with all that
the denoiser does to both halves alike, which the difference D(A) - D(B) does not show. Less
1/4 (D(A) - D(B))^2 it is that of the mean of both denoised halves, ((a + b) / 2)^2. The picture is
one denoise of all samples, and better than this mean.

Errors are wanted in a curve f: log10(1 + radiance), or radiance clamped to [0, 1]. There a
difference counts times the slope of f's secant between the denoised and the raw mean of both
halves: it makes f(D) - f(T) of D - T where the raw mean is near the truth, and keeps one bright
sample from counting for more than f makes of it.

Without a denoiser a and b are the noises themselves, and 1/2 (f(A) - f(B))^2 is stated, which is
the squared error of one half. That of their mean is half of it only where no light is rare: stated
so, 7 of 8 raw pictures were 0.7 to 2.2 dB worse.

Two allowances are added to the mean over the pixels:

- Standard errors of that mean, over blocks of pixels, since errors of neighbours go together: one
  in log light, and two in linear light, where a few bright pixels are most of the error.
- The brightest surprise. The estimate is right on average because now and then both halves find
  the same rare light in the same pixel (x y). Until they do, it is too small. The largest
  difference, in f, between the raw mean and the denoised one might be such light: it is counted as
  one pixel that is wrong by it.

Light that no sample has found is not seen: a view whose only caustic was never hit looks converged.

The terms of each pixel are in pipeline.renders.pictures, for numpy and for kernels, which hands
their sums over blocks to `measured_floor` here. The error that is stated by
calibration on other scenes is in pipeline.renders.calibrated_error.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.metrics import MAX_DB
from storage.records.sample import PictureErrors

BLOCK_PX = 8
"""Pixels across the blocks of the standard error: errors of a denoised picture are correlated over
a few pixels."""

SMALLEST_STEP = 1e-4
"""Radiance, relative to 1 + radiance, over which a secant is taken at least: below it, differences
of float32 values are rounding."""

_STANDARD_ERRORS = (1.0, 2.0, 1.0)
"""Of log and linear light and of objects, added to the mean. With one, 3 to 10 % of the linear
floors of 16 scenes were more than 1 dB too good (study S16)."""

Curve = Callable[[Any], Any]
"""What errors are taken in, of radiance."""


FLOOR_METRICS = {
    "noise_floor_db": "psnr_log_db",
    "noise_floor_linear_db": "psnr_linear_db",
    "object_noise_floor_db": "object_psnr_log_db",
}
"""The metric of each error (storage.metrics)."""


def by_metric(floor: PictureErrors) -> dict[str, float]:
    """Return the three errors of a floor in dB by the name of their metric."""
    return {metric: getattr(floor, field) for field, metric in FLOOR_METRICS.items()}


@dataclass(frozen=True, kw_only=True)
class ErrorMeasures:
    """Measures of the squared error of one picture in one curve, as means over its pixels.

    The picture D is one denoise of the raw mean X of both halves; M is the mean of both denoised
    halves.
    """

    estimate: float
    """The unbiased estimate of the module's head, of M; by chance below 0."""
    agreement: float
    """Variance of M by the difference of the two denoised halves."""
    move: float
    """Squared difference between D and M."""
    surprise: float
    """Largest squared difference between X and M in a pixel, shared by all pixels."""
    sure: float
    """Stein's estimate of D's error, with the difference of the halves as the probe: the mean of
    (D - X)^2 + z (D(A) - D(B)) - z^2, z = (A - B) / 2. Differences are averaged over blocks of
    BLOCK_PX before they are squared; by chance below 0."""
    block_agreement: float
    """Agreement of differences that are averaged so, as a part of `agreement`; it restores what the
    average over blocks takes from `sure`."""
    hits: float
    """Share of the pixels of the picture that show geometry."""


def measured_floor(
    rows: Iterable[tuple[float, NDArray[np.float64], NDArray[np.float64]]],
) -> PictureErrors:
    """Return the floor of a picture.

    Args:
        rows: of log and linear light and of objects: greatest surprise of a pixel, and [T] the sums
            of estimates and the pixels of each block. Where there are no pixels at all, the floor
            is the highest.
    """
    floors_db = []
    for (surprise, sums, counts), deviations in zip(rows, _STANDARD_ERRORS, strict=True):
        count = counts.sum()
        bound = 0.0
        if count:
            bound = max(sums.sum() / count, 0.0) + surprise / count
            bound += deviations * _standard_error(sums, counts)
        smallest = 10 ** (-MAX_DB / 10)
        floors_db.append(MAX_DB if bound <= smallest else float(-10 * np.log10(bound)))
    return PictureErrors(**dict(zip(FLOOR_METRICS, floors_db, strict=True)))


def _standard_error(sums: NDArray[np.float64], counts: NDArray[np.float64]) -> float:
    """Return the standard error of the mean error over the pixels, from sums over blocks."""
    total = counts.sum()
    deviations = sums - counts * (sums.sum() / total)
    blocks = np.count_nonzero(counts)
    spread = np.square(deviations).sum() * blocks / max(blocks - 1, 1)
    return float(np.sqrt(spread) / total)


def secant_slope(
    curve: Curve, first: Any, second: Any, *, select: Callable[..., Any] = np.where
) -> Any:
    """Return the slope of the line through two points of a curve, or its own where they are one."""
    step = second - first
    least = SMALLEST_STEP * (1 + abs(first))
    step = select(abs(step) < least, least, step)
    return (curve(first + step) - curve(first)) / step


def clamped_radiance(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return radiance clamped to [0, 1], the space of psnr_linear_db."""
    return np.clip(radiance, 0, 1)
