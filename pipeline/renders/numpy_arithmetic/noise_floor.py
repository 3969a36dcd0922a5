"""The stated error of a picture as numpy has it: pipeline.renders.noise_floor says what it is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.noise_floor import (
    BLOCK_PX,
    LINEAR_STANDARD_ERRORS,
    Curve,
    ErrorMeasures,
    MeasuredFloor,
    clamped_radiance,
    estimate_noise_floor_db,
    secant_slope,
)
from storage.conventions import log10_radiance


@dataclass(frozen=True, kw_only=True, eq=False)
class Half:
    """One half of the samples of a view."""

    raw_rgb: NDArray[np.float32]
    """[R, R, 3] mean of the samples."""
    denoised_rgb: NDArray[np.float32]
    """[R, R, 3] the same, denoised."""


def estimate_error(a: Half, b: Half, hits: NDArray[np.bool_]) -> MeasuredFloor:
    """Return the floor of the picture made from both halves.

    Args:
        a, b: halves that share no sample, denoised apart.
        hits: [R, R] pixels that show geometry.
    """
    everywhere = np.ones_like(hits)
    return MeasuredFloor(
        log_db=_floor_db(a, b, log10_radiance, everywhere),
        linear_db=_floor_db(a, b, clamped_radiance, everywhere, LINEAR_STANDARD_ERRORS),
        object_log_db=_floor_db(a, b, log10_radiance, hits),
    )


def squared_error(a: Half, b: Half, curve: Curve) -> NDArray[np.float64]:
    """Return an estimate of the squared error of the mean of both denoised halves, [R, R].

    It is the mean over the channels. Single pixels may be far below 0; the mean over many pixels
    is what it is for.
    """
    raw_a = a.raw_rgb.astype(np.float64)
    raw_b = b.raw_rgb.astype(np.float64)
    if np.array_equal(a.denoised_rgb, a.raw_rgb):
        of_half: NDArray[np.float64] = 0.5 * np.square(curve(raw_a) - curve(raw_b)).mean(axis=-1)
        return of_half
    of_halves = 0.5 * (np.square(a.denoised_rgb - raw_b) + np.square(b.denoised_rgb - raw_a))
    noise = 0.5 * np.square(raw_a - raw_b)
    half_difference_sq = 0.25 * np.square(a.denoised_rgb - b.denoised_rgb, dtype=np.float64)
    slope = secant_slope(curve, *_means(a, b))
    estimate = of_halves - noise - half_difference_sq
    mean: NDArray[np.float64] = (np.square(slope) * estimate).mean(axis=-1)
    return mean


def surprises(a: Half, b: Half, curve: Curve) -> NDArray[np.float64]:
    """Return the squared difference that the denoiser made in each pixel of the mean, [R, R]."""
    denoised, raw = _means(a, b)
    squared: NDArray[np.float64] = np.square(curve(raw) - curve(denoised)).mean(axis=-1)
    return squared


def measure_errors(
    a: Half, b: Half, picture_rgb: NDArray[np.float32], curve: Curve, hits: NDArray[np.bool_],
    *, objects: bool = False,
) -> ErrorMeasures:  # fmt: skip
    """Return what the halves say of the error of the picture of both.

    Args:
        a, b: halves that share no sample, denoised apart.
        picture_rgb: [R, R, 3] one denoise of the mean of both.
        curve: tone curve in which errors are taken.
        hits: [R, R] pixels that show geometry.
        objects: count these pixels alone.
    """
    pixels = hits if objects else np.ones_like(hits)
    count = max(int(pixels.sum()), 1)
    denoised, raw = _means(a, b)
    picture = picture_rgb.astype(np.float64)
    slope = secant_slope(curve, picture, raw) * pixels[..., None]
    residual = slope * (picture - raw)
    probe = slope * (0.5 * (a.raw_rgb.astype(np.float64) - b.raw_rgb))
    difference = slope * (a.denoised_rgb.astype(np.float64) - b.denoised_rgb)
    blocks = [_block_means(values) for values in (residual, probe, difference)]
    to_mean = BLOCK_PX**2 / count

    def over_pixels(values: NDArray[np.float64]) -> float:
        return float((values.mean(axis=-1) * pixels).sum() / count)

    of_halves = [curve(half.denoised_rgb.astype(np.float64)) for half in (a, b)]
    agreement_in_blocks = 0.25 * np.square(blocks[2]).mean(axis=-1).sum() * to_mean
    agreement_in_pixels = 0.25 * np.square(difference).mean(axis=-1).sum() / count
    return ErrorMeasures(
        estimate=float((squared_error(a, b, curve) * pixels).sum() / count),
        agreement=over_pixels(0.25 * np.square(of_halves[0] - of_halves[1])),
        move=over_pixels(np.square(curve(picture) - curve(denoised))),
        surprise=float((surprises(a, b, curve) * pixels).max() / count),
        sure=float(
            (np.square(blocks[0]) + blocks[1] * blocks[2] - np.square(blocks[1]))
            .mean(axis=-1).sum() * to_mean
        ),
        block_agreement=float(agreement_in_blocks / agreement_in_pixels)
        if agreement_in_pixels
        else 1.0,
        hits=float(hits.mean()),
    )  # fmt: skip


def _block_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    across = len(values) // BLOCK_PX
    means: NDArray[np.float64] = values.reshape(across, BLOCK_PX, across, BLOCK_PX, 3).mean((1, 3))
    return means


def _means(a: Half, b: Half) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the means of both halves, denoised and raw."""
    denoised = 0.5 * (a.denoised_rgb.astype(np.float64) + b.denoised_rgb)
    return denoised, 0.5 * (a.raw_rgb.astype(np.float64) + b.raw_rgb)


def _floor_db(
    a: Half, b: Half, curve: Curve, pixels: NDArray[np.bool_], standard_errors: float = 1.0
) -> float:
    error = squared_error(a, b, curve) * pixels
    surprise = float((surprises(a, b, curve) * pixels).max())
    mean = error.sum() / max(int(pixels.sum()), 1)
    counts = _block_sums(pixels.astype(np.float64))
    return estimate_noise_floor_db(mean, surprise, _block_sums(error), counts, standard_errors)


def _block_sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
    across = len(values) // BLOCK_PX
    blocks = values.reshape(across, BLOCK_PX, across, BLOCK_PX)
    sums: NDArray[np.float64] = blocks.sum(axis=(1, 3)).ravel()
    return sums
