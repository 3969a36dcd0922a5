"""Light adds up: a scene whose lights are stronger or weaker has a picture that is known.

The network reads emission, and pictures are compared, as log10(1 + x): both are taken back to
radiance and forth again, to the rounding of float32.
"""

import dataclasses
import math

import torch
from torch import Tensor

from model.scene_tensors import SceneTensors
from storage.records.material import laid_out
from train.data.scenes import TrainingScene

LN_10 = math.log(10.0)


def with_light_scaled(scene: TrainingScene, factor: float) -> TrainingScene:
    """Return the scene with all of its light `factor` times as strong; lights apart are let go."""
    factor_T = torch.full((scene.tensors.num_triangles,), factor)
    return dataclasses.replace(
        scene,
        tensors=_relit(scene.tensors, factor_T),
        target_VRR3=_log10(factor * _linear(scene.target_VRR3)),
        lights_VLRR3=None,
    )


def with_lights_mixed(scene: TrainingScene, factor_L: Tensor) -> TrainingScene:
    """Return the scene with light i `factor_L[i]` times as strong; lights apart are let go.

    The scene must keep them (train.data.scenes).
    """
    assert scene.lights_VLRR3 is not None
    factor_T = torch.cat([factor_L, torch.ones(1)])[scene.light_T]  # -1: belongs to no light
    mixed_VRR3 = torch.einsum("l,vlijc->vijc", factor_L, scene.lights_VLRR3)
    return dataclasses.replace(
        scene,
        tensors=_relit(scene.tensors, factor_T),
        target_VRR3=_log10(mixed_VRR3),
        lights_VLRR3=None,
    )


def _relit(tensors: SceneTensors, factor_T: Tensor) -> SceneTensors:
    """Return the tensors with the radiance of each triangle's material so many times as strong."""
    material_TM = tensors.material_TM.clone()
    for column, part in laid_out(tensors.columns):
        if column.is_radiance and column.is_log_encoded:
            material_TM[:, part] = _log10(factor_T[:, None] * _linear(material_TM[:, part]))
        elif column.is_radiance:
            material_TM[:, part] *= factor_T[:, None]
    return dataclasses.replace(tensors, material_TM=material_TM)


def _linear(log10: Tensor) -> Tensor:
    return torch.expm1(log10 * LN_10)


def _log10(linear: Tensor) -> Tensor:
    return torch.log1p(linear) / LN_10
