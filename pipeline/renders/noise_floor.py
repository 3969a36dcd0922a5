"""How wrong a picture is, measured without a reference: each half of its samples judges the other.

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
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.conventions import log10_radiance
from storage.metrics import MAX_DB

_BLOCK_PX = 8
"""Pixels across the blocks of the standard error: errors of a denoised picture are correlated over
a few pixels."""

_SMALLEST_STEP = 1e-4
"""Radiance, relative to 1 + radiance, over which a secant is taken at least: below it, differences
of float32 values are rounding."""

_LINEAR_STANDARD_ERRORS = 2.0
"""Of one, 3 to 10 % of the linear floors of 16 scenes were more than 1 dB too good (study S16)."""

Curve = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""What errors are taken in, of radiance."""


@dataclass(frozen=True, kw_only=True)
class MeasuredFloor:
    """The measured error of one picture, in dB."""

    log_db: float
    """As psnr_log_db: this one is meant by "noise floor"."""
    linear_db: float
    """As psnr_linear_db."""
    object_log_db: float
    """As object_psnr_log_db: over the pixels that show geometry."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Half:
    """One half of the samples of a view."""

    raw_rgb: NDArray[np.float32]
    """[R, R, 3] mean of the samples."""
    denoised_rgb: NDArray[np.float32]
    """[R, R, 3] the same, denoised."""


def measure_floor(a: Half, b: Half, hits: NDArray[np.bool_]) -> MeasuredFloor:
    """Return the floor of the picture made from both halves.

    Args:
        a, b: halves that share no sample, denoised apart.
        hits: [R, R] pixels that show geometry.
    """
    everywhere = np.ones_like(hits)
    return MeasuredFloor(
        log_db=_floor_db(a, b, log10_radiance, everywhere),
        linear_db=_floor_db(a, b, clamped_radiance, everywhere, _LINEAR_STANDARD_ERRORS),
        object_log_db=_floor_db(a, b, log10_radiance, hits),
    )


def squared_error(a: Half, b: Half, curve: Curve) -> NDArray[np.float64]:
    """Return an estimate of the squared error of the mean of both denoised halves, [R, R].

    It is the mean over the channels. Single pixels may be far below 0; the mean over many pixels
    is what it is for.
    """
    raw_a, raw_b = a.raw_rgb.astype(np.float64), b.raw_rgb.astype(np.float64)
    if np.array_equal(a.denoised_rgb, a.raw_rgb):
        of_half: NDArray[np.float64] = 0.5 * np.square(curve(raw_a) - curve(raw_b)).mean(axis=-1)
        return of_half
    of_halves = 0.5 * (np.square(a.denoised_rgb - raw_b) + np.square(b.denoised_rgb - raw_a))
    noise = 0.5 * np.square(raw_a - raw_b)
    apart = 0.25 * np.square(a.denoised_rgb - b.denoised_rgb, dtype=np.float64)
    slope = secant_slope(curve, *_means(a, b))
    estimate = of_halves - noise - apart
    mean: NDArray[np.float64] = (np.square(slope) * estimate).mean(axis=-1)
    return mean


def surprises(a: Half, b: Half, curve: Curve) -> NDArray[np.float64]:
    """Return the squared difference that the denoiser made in each pixel of the mean, [R, R]."""
    denoised, raw = _means(a, b)
    squared: NDArray[np.float64] = np.square(curve(raw) - curve(denoised)).mean(axis=-1)
    return squared


def _means(a: Half, b: Half) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the means of both halves, denoised and raw."""
    denoised = 0.5 * (a.denoised_rgb.astype(np.float64) + b.denoised_rgb)
    return denoised, 0.5 * (a.raw_rgb.astype(np.float64) + b.raw_rgb)


def _floor_db(
    a: Half, b: Half, curve: Curve, pixels: NDArray[np.bool_], standard_errors: float = 1.0
) -> float:
    count = int(pixels.sum())
    if not count:
        return MAX_DB
    error = squared_error(a, b, curve) * pixels
    surprise = float((surprises(a, b, curve) * pixels).max()) / count
    bound = max(error.sum() / count, 0.0) + surprise
    bound += standard_errors * _standard_error(error, pixels)
    return MAX_DB if bound <= 10 ** (-MAX_DB / 10) else float(-10 * np.log10(bound))


def _standard_error(error: NDArray[np.float64], pixels: NDArray[np.bool_]) -> float:
    """Return that of the mean of `error` over the pixels, from its sums over blocks."""
    sums, counts = _block_sums(error), _block_sums(pixels.astype(np.float64))
    total = counts.sum()
    apart = sums - counts * (sums.sum() / total)
    blocks = np.count_nonzero(counts)
    spread = np.square(apart).sum() * blocks / max(blocks - 1, 1)
    return float(np.sqrt(spread) / total)


def _block_sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
    across = len(values) // _BLOCK_PX
    blocks = values.reshape(across, _BLOCK_PX, across, _BLOCK_PX)
    sums: NDArray[np.float64] = blocks.sum(axis=(1, 3)).ravel()
    return sums


def secant_slope(
    curve: Curve, first: NDArray[np.float64], second: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the slope of the line through two points of a curve, or its own where they are one."""
    step = second - first
    least = _SMALLEST_STEP * (1 + np.abs(first))
    step = np.where(np.abs(step) < least, least, step)
    slope: NDArray[np.float64] = (curve(first + step) - curve(first)) / step
    return slope


def clamped_radiance(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return radiance clamped to [0, 1], the space of psnr_linear_db."""
    return np.clip(radiance, 0, 1)
