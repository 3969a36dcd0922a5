"""`Sample` -> `TrainingScene`: the tensors that one scene contributes to a step."""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np
import torch
from torch import Tensor

from model.scene_tensors import SceneTensors, scene_tensors
from storage.conventions import log10_radiance
from storage.errors import TrilightError
from storage.sample import Sample
from train.data.resolution import block_mean


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingScene:
    """One scene and the pictures that the network should make of it."""

    key: str
    """Key of the sample."""
    tensors: SceneTensors
    """What the network reads."""
    target_VRR3: Tensor
    """float32 log10(1 + radiance), one picture per camera in `tensors`."""


def training_scene(sample: Sample, resolution: int) -> TrainingScene:
    """Return a sample at the resolution of the run.

    Raises:
        TrilightError: the resolution is no divisor of the sample's, or a picture holds a value
            that is not finite or is negative. Such a value would reach every weight in one step.
    """
    if not (sample.radiance_rgb.min() >= 0 and sample.radiance_rgb.max() < np.inf):
        _refuse(sample)
    radiance_VRR3 = block_mean(sample.radiance_rgb, resolution)
    return TrainingScene(
        key=sample.key,
        tensors=scene_tensors(sample.scene),
        target_VRR3=torch.from_numpy(log10_radiance(radiance_VRR3).astype(np.float32)),
    )


def _refuse(sample: Sample) -> NoReturn:
    wrong = np.argwhere(~(np.isfinite(sample.radiance_rgb) & (sample.radiance_rgb >= 0)))
    view, row, column, channel = (int(index) for index in wrong[0])
    value = sample.radiance_rgb[view, row, column, channel]
    raise TrilightError(
        f"sample {sample.key}: view {view} has radiance {value} at pixel ({row}, {column}); "
        "expected finite values from 0. Run `trilight verify` on the dataset."
    )
