"""Pictures of one view at rising numbers of samples, each with its price."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPicture:
    """One view with a fixed number of samples."""

    spp: int
    """Samples per pixel."""
    radiance_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance."""
    core_s: float
    """Core-seconds of this picture alone, kernels warm and scene loaded."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPictures:
    """One view at every level."""

    load_core_s: float
    """Core-seconds of loading the scene."""
    levels: tuple[SampledPicture, ...]
    """From few samples to many: each holds the samples of the one before."""
