"""`Sample` -> `TrainingScene`: the tensors that one scene contributes to a step."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.scene_tensors import SceneTensors, scene_tensors
from storage.conventions import log10_radiance
from storage.errors import TrilightError
from storage.records.lights import light_rows
from storage.records.sample import Sample
from storage.records.scene import Scene
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
    noise_V: Tensor
    """float32 root mean square noise of the stored pictures in the same space; fewer pixels have
    less."""
    light_T: Tensor
    """int64: which light a triangle belongs to (storage.records.lights), -1 for none."""
    lights_VLRR3: Tensor | None = None
    """float32 linear radiance of each light alone, where it was asked for; their sum is the
    picture."""


def training_scene(
    sample: Sample, resolution: int, *, most_triangles: int = 0, lights_apart: bool = False
) -> TrainingScene:
    """Return a sample at the resolution of the run.

    Args:
        sample: what to return; it passes `Sample.check`.
        resolution: pixels across the pictures.
        most_triangles: scenes with more are refused; 0: none is.
        lights_apart: whether each light's own pictures are wanted.

    Raises:
        TrilightError: the resolution is no divisor of the sample's, or the scene has too many
            triangles or keeps its lights together.
    """
    if 0 < most_triangles < sample.scene.num_triangles:
        raise TrilightError(
            f"sample {sample.key}: {sample.scene.num_triangles} triangles; the run takes at most "
            f"{most_triangles}. Set most_triangles, or skip such samples."
        )
    radiance_VRR3 = block_mean(sample.radiance_rgb, resolution)
    floors_db = np.array([view.noise_floor_db for view in sample.views], np.float32)
    return TrainingScene(
        key=sample.key,
        tensors=scene_tensors(sample.scene),
        target_VRR3=torch.from_numpy(log10_radiance(radiance_VRR3).astype(np.float32)),
        noise_V=torch.from_numpy(10 ** (-floors_db / 20)),
        light_T=torch.from_numpy(_lights_of_triangles(sample.scene)),
        lights_VLRR3=_lights_apart(sample, resolution) if lights_apart else None,
    )


def _lights_of_triangles(scene: Scene) -> NDArray[np.int64]:
    light_of_object = np.full(len(scene.objects), -1, np.int64)
    rows = list(light_rows(scene))
    light_of_object[rows] = np.arange(len(rows))
    return light_of_object[scene.object_index]


def _lights_apart(sample: Sample, resolution: int) -> Tensor:
    if sample.lights_rgb is None:
        raise TrilightError(
            f"sample {sample.key}: its lights are not kept apart, which light_mix needs. Generate "
            "the dataset with --set renders.per_light=true, or set augmentation.light_mix=1."
        )
    smaller = [block_mean(lights, resolution) for lights in sample.lights_rgb]
    return torch.from_numpy(np.stack(smaller))
