"""Stated errors of pictures, compared with true errors to raw references (infra.render)."""

import numpy as np
from numpy.typing import NDArray

from infra.render.raw_references import LEAST_ERROR, RawReference, true_error_db
from pipeline.renders.noise_floor import Curve, clamped_radiance, secant_slope
from pipeline.renders.results import RenderedView
from storage.conventions import log10_radiance

_CURVES = {"log": log10_radiance, "linear": clamped_radiance, "object": log10_radiance}


def figures(view: RenderedView, reference: RawReference) -> dict[str, float]:
    """Return stated and true errors of a picture in dB, with the reference's uncertainty."""
    mean = 0.5 * (reference.a_rgb + reference.b_rgb)
    stated_db = {
        "log": view.noise_floor_db,
        "linear": view.noise_floor_linear_db,
        "object": view.object_noise_floor_db,
    }
    values = {
        "spp": float(view.spp),
        "at_cap": float(view.at_cap),
        "brightness": 100 * float(view.radiance_rgb.mean() / mean.mean() - 1),
    }
    for name, curve in _CURVES.items():
        pixels = view.hits if name == "object" else np.ones_like(view.hits)
        true_db, open_db = true_error_db(view.radiance_rgb, reference, curve, pixels)
        excess_db = stated_db[name] - true_db
        values |= {
            f"{name}_stated_db": stated_db[name],
            f"{name}_true_db": true_db,
            f"{name}_open_db": open_db,
            f"{name}_caution_db": -excess_db,
            f"{name}_over_1": float(excess_db > 1),
            f"{name}_over_3": float(excess_db > 3),
        }
    return values


def difference_db(ours: RawReference, theirs: RawReference, curve: Curve) -> float:
    """Return the difference of two renderers in dB, without the noise of both.

    The squared difference is the mean of (A - C) (B - D), with halves A and B of one and C and D of
    the other. It may be below 0 by chance, which counts as no difference.
    """
    means = (0.5 * (one.a_rgb + one.b_rgb) for one in (ours, theirs))
    weight = np.square(secant_slope(curve, *means))
    product = (ours.a_rgb - theirs.a_rgb) * (ours.b_rgb - theirs.b_rgb)
    return float(-10 * np.log10(max((weight * product).mean(), LEAST_ERROR)))


def shrunk(reference: RawReference, resolution: int) -> RawReference:
    """Return a reference of a smaller width, which divides the reference's."""
    return RawReference(
        a_rgb=_block_means(reference.a_rgb, resolution),
        b_rgb=_block_means(reference.b_rgb, resolution),
    )


def _block_means(picture: NDArray[np.float64], resolution: int) -> NDArray[np.float64]:
    size = len(picture) // resolution
    blocks = picture.reshape(resolution, size, resolution, size, 3)
    means: NDArray[np.float64] = blocks.mean(axis=(1, 3))
    return means
