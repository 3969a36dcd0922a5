"""Light adds up: a scene whose lights are stronger or weaker has a picture that is known.

The network reads emission, and pictures are compared, as log10(1 + x): both are taken back to
radiance and forth again, to the rounding of float32.
"""

import dataclasses
import math

import torch
from torch import Tensor

from storage.conventions import EMISSION
from train.data.scenes import TrainingScene

LN_10 = math.log(10.0)


def with_light_scaled(scene: TrainingScene, factor: float) -> TrainingScene:
    """Return the scene with all of its light `factor` times as strong; lights apart are let go."""
    columns = scene.tensors.material_T10.clone()
    columns[:, EMISSION] = _log10(factor * _linear(columns[:, EMISSION]))
    return dataclasses.replace(
        scene,
        tensors=dataclasses.replace(scene.tensors, material_T10=columns),
        target_VRR3=_log10(factor * _linear(scene.target_VRR3)),
        lights_VLRR3=None,
    )


def with_lights_mixed(scene: TrainingScene, factor_L: Tensor) -> TrainingScene:
    """Return the scene with light i `factor_L[i]` times as strong; lights apart are let go.

    The scene must keep them (train.data.scenes).
    """
    assert scene.lights_VLRR3 is not None
    columns = scene.tensors.material_T10.clone()
    factor_T = torch.cat([factor_L, torch.ones(1)])[scene.light_T]  # -1: belongs to no light
    columns[:, EMISSION] = _log10(factor_T[:, None] * _linear(columns[:, EMISSION]))
    mixed_VRR3 = torch.einsum("l,vlijc->vijc", factor_L, scene.lights_VLRR3)
    return dataclasses.replace(
        scene,
        tensors=dataclasses.replace(scene.tensors, material_T10=columns),
        target_VRR3=_log10(mixed_VRR3),
        lights_VLRR3=None,
    )


def _linear(log10: Tensor) -> Tensor:
    return torch.expm1(log10 * LN_10)


def _log10(linear: Tensor) -> Tensor:
    return torch.log1p(linear) / LN_10
