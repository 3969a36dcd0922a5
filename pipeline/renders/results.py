"""Results of a renderer: progress, pictures that grow, and finished pictures."""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.noise_floor import MeasuredFloor
from storage.records.lights import Parts
from storage.renderer import Sampling

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedView:
    """One finished picture with its measured error."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance, finite, at least 0, below HALF_FLOAT_MAX; the background is 0."""
    spp: int
    """Samples per pixel that were spent, on each light where they are apart: the mean over the
    pixels that show anything, rounded down."""
    noise_floor_db: float
    """Measured error as psnr_log_db, in dB; more is better."""
    noise_floor_linear_db: float
    """Measured error as psnr_linear_db, in dB; more is better."""
    object_noise_floor_db: float
    """Measured error as object_psnr_log_db over `hits`, in dB; more is better."""
    expected_error: MeasuredFloor | None = None
    """Errors that are as often better as worse, in dB, where the three above are calibrated bounds
    (pipeline.renders.calibrated_error); None where they are bounds by estimate and allowances."""
    at_cap: bool
    """True if sampling ended at max_spp with a floor below its target."""
    core_s: float
    """Core-seconds that the picture took, without its looks and without loading the scene."""
    hits: NDArray[np.bool_]
    """[R, R] true where the ray through a pixel's center hits geometry other than emitters."""
    lights_rgb: NDArray[np.float32] | None = None
    """[L, R, R, 3] radiance of each emitter object and then of the sky alone, with `per_light`;
    rounded to half floats.
    `radiance_rgb` is their storage.records.lights.sum_of_lights in every bit."""
    parts_rgb: Parts | None = None
    """[R, R, 3] radiance of each part, with `split` or `split_lobes`; rounded to half floats. With
    `per_light` [L, R, R, 3]. Their storage.records.lights.sum_of_parts is `radiance_rgb`, or
    `lights_rgb`, in every bit."""
    part_floors: Mapping[str, MeasuredFloor] | None = None
    """Measured error of each part, of all lights together."""
    light_floors: Sequence[MeasuredFloor] | None = None
    """Measured error of each of `lights_rgb`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GrowingPicture(Sampling):
    """A picture of the samples so far, for display while it improves."""

    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance that half floats can hold."""
    floor: MeasuredFloor | None
    """Measured error of the picture; None if there are too few samples."""
    core_s: float
    """Core-seconds that a picture as good as this one takes, without the looks before it and
    without loading the scene."""


def run_to_end(steps: Iterator[Sampling | Result]) -> Result:
    """Return what a rendering yields last, its result, without the progress before."""
    return cast(Result, deque(steps, maxlen=1).pop())
