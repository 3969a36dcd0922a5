"""What the denoiser may not change, as numpy has it: see pipeline.renders.denoise_corrections."""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.renders.denoise_corrections import (
    DARKER,
    GLINT,
    MOST_APART,
    STANDARD_ERRORS,
    STANDS_OUT,
)

Pictures = NDArray[np.float32]
"""[P, R, R, 3] pictures of the parts of light of one view."""


def keep_converged(
    denoised_rgb: NDArray[np.float32],
    raw_rgb: NDArray[np.float32],
    standard_error: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return the denoised picture with the raw pixels of `converged_mask`."""
    mask = converged_mask(denoised_rgb, raw_rgb, standard_error)
    return np.where(mask[..., None], raw_rgb, denoised_rgb)


def keep_in_halves(
    halves: Sequence[tuple[Pictures, Pictures]], standard_error: NDArray[np.float64]
) -> list[tuple[Pictures, Pictures]]:
    """Return both halves, raw and denoised, with the pixels that the mean of both keeps.

    So the floor is that of the picture: of a glint that is kept, what remains is its noise.
    """
    raw_rgb, denoised_rgb = (np.mean(pictures, axis=0) for pictures in zip(*halves, strict=True))
    mask = converged_mask(denoised_rgb, raw_rgb, standard_error)[..., None]
    return [(raw, np.where(mask, raw, denoised)) for raw, denoised in halves]


def converged_mask(
    denoised_rgb: NDArray[np.floating],
    raw_rgb: NDArray[np.floating],
    standard_error: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return which pixels [R, R] of the raw picture are right rather than the denoised ones.

    Args:
        denoised_rgb: [P, R, R, 3] linear radiance of the parts of a picture, which is their sum.
        raw_rgb: [P, R, R, 3] the mean of the samples.
        standard_error: [R, R] of the mean over the channels of the sum of `raw_rgb`, from the
            spread between at least LEAST_PASSES passes.
    """
    raw, denoised = (
        parts.sum(axis=0).mean(axis=-1, dtype=np.float64) for parts in (raw_rgb, denoised_rgb)
    )
    bright = raw - denoised > STANDARD_ERRORS * standard_error
    around = np.sqrt(sliding_window_view(np.pad(standard_error**2, 1, "edge"), (3, 3)).mean((2, 3)))
    dark = denoised - raw > STANDARD_ERRORS * around
    mask: NDArray[np.bool_] = bright & (raw > STANDS_OUT * denoised)
    mask |= dark & (denoised > DARKER * raw)
    return mask


def with_mean_of(
    denoised_rgb: NDArray[np.float32], raw_rgb: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the denoised picture with the mean brightness of the raw one.

    Args:
        denoised_rgb: [..., 3] linear radiance.
        raw_rgb: the same view before the denoiser.
    """
    glints = denoised_rgb.mean(axis=-1) > GLINT
    factors = [_factor(denoised_rgb[part], raw_rgb[part]) for part in (glints, ~glints)]
    if min(factors) < 1 / MOST_APART or max(factors) > MOST_APART:
        factors = [_factor(denoised_rgb, raw_rgb)] * 2
    return (denoised_rgb * np.where(glints, *factors)[..., None]).astype(np.float32)


def _factor(denoised_rgb: NDArray[np.float32], raw_rgb: NDArray[np.float32]) -> float:
    is_now = denoised_rgb.sum(dtype=np.float64)
    return float(raw_rgb.sum(dtype=np.float64) / is_now) if is_now > 0 else 1.0
