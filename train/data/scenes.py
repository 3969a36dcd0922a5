"""A sample -> `TrainingScene`: the tensors that one scene contributes to a step.

Most targets are half floats at the resolution of the run, of which there are 31,744. What is done
to their values (log10(1 + x), stronger light) is done to these once and looked up for each pixel,
in a decoding thread or on the card: the same numbers for a tenth of the work.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.scene_tensors import SceneTensors, scene_tensors
from storage.conventions import log10_radiance
from storage.errors import TrilightError
from storage.records.exr import FIRST_ILLEGAL, HALF_FLOATS, Stored, unpacked
from storage.records.lights import light_rows
from storage.records.sample import Sample, ViewRecord
from storage.records.scene import Scene
from storage.records.stored_sample import StoredSample
from train.data.resolution import block_mean, require_divisor


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingScene:
    """One scene and the pictures that the network should make of it."""

    key: str
    """Key of the sample."""
    tensors: SceneTensors
    """What the network reads."""
    target_VRR3: Tensor
    """float32 log10(1 + radiance), one picture per camera in `tensors`; with `levels_L`, int16 rows
    of it."""
    noise_V: Tensor
    """float32 root mean square noise of the stored pictures in the same space; fewer pixels have
    less."""
    light_T: Tensor
    """int64: which light a triangle belongs to (storage.records.lights), -1 for none."""
    lights_VLRR3: Tensor | None = None
    """float32 linear radiance of each light alone, where it was asked for; their sum is the
    picture."""
    levels_L: Tensor | None = None
    """float32 log10(1 + radiance) of every half float that a picture may hold, where the target is
    yet to be looked up (`with_target`)."""


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
    require_few_triangles(sample.key, sample.scene, most_triangles)
    scene = _scene_of(sample.key, sample.scene, sample.views, sample.radiance_rgb, resolution)
    if not lights_apart:
        return scene
    return _with_lights(scene, sample.lights_rgb, resolution)


def drawn_scene(
    sample: StoredSample, views: Sequence[int], resolution: int, *, lights_apart: bool = False
) -> TrainingScene:
    """Return some views of a sample, whose other pictures are not unpacked.

    Where pictures are half floats of the wanted resolution, the target is yet to be looked up.

    Args:
        sample: what to return.
        views: rows of its cameras, at least one.
        resolution: as in `training_scene`.
        lights_apart: as in `training_scene`.

    Raises:
        TrilightError: a picture that is damaged or breaks a law; and as `training_scene`.
    """
    pictures, rows = sample.pictures(views), list(views)
    scene = dataclasses.replace(
        sample.scene, c2w=sample.scene.c2w[rows], fov_deg=sample.scene.fov_deg[rows]
    )
    records = [sample.views[row] for row in rows]
    drawn = _scene_of(sample.key, scene, records, pictures, resolution)
    if not lights_apart:
        return drawn
    lights_rgb = sample.lights_rgb(views, pictures.shape[1])
    return _with_lights(drawn, lights_rgb, resolution)


def with_target(scene: TrainingScene) -> TrainingScene:
    """Return a scene whose target is log10(1 + radiance), looked up where it has not been."""
    if scene.levels_L is None:
        return scene
    # legal bits need no check of their range, which would take a copy
    target = np.take(scene.levels_L.numpy(), scene.target_VRR3.numpy(), mode="clip")
    return dataclasses.replace(scene, target_VRR3=torch.from_numpy(target), levels_L=None)


def require_few_triangles(key: str, scene: Scene, most: int) -> None:
    """Raise TrilightError where a scene has more than `most` triangles; at 0 there is no limit."""
    if 0 < most < scene.num_triangles:
        raise TrilightError(
            f"sample {key}: {scene.num_triangles} triangles; the run takes at most {most}. Set "
            "most_triangles, or skip such samples."
        )


@cache
def stored_levels() -> Tensor:
    """Return float32 [31744]: log10(1 + x) of every half float x from 0 on, by its bits."""
    return torch.from_numpy(log10_radiance(HALF_FLOATS[:FIRST_ILLEGAL]).astype(np.float32))


def _scene_of(
    key: str, scene: Scene, views: Sequence[ViewRecord], pictures: Stored, resolution: int
) -> TrainingScene:
    """Return a scene with the pictures of all of its cameras."""
    require_divisor(resolution, pictures.shape[1])
    levels_L = None
    if pictures.dtype == np.uint16 and pictures.shape[1] == resolution:
        target_VRR3, levels_L = torch.from_numpy(pictures.view(np.int16)), stored_levels()
    else:
        radiance_VRR3 = block_mean(unpacked(pictures), resolution)
        target_VRR3 = torch.from_numpy(log10_radiance(radiance_VRR3).astype(np.float32))
    floors_db = np.array([view.noise_floor_db for view in views], np.float32)
    return TrainingScene(
        key=key,
        tensors=scene_tensors(scene),
        target_VRR3=target_VRR3,
        noise_V=torch.from_numpy(10 ** (-floors_db / 20)),
        light_T=torch.from_numpy(_lights_of_triangles(scene)),
        levels_L=levels_L,
    )


def _lights_of_triangles(scene: Scene) -> NDArray[np.int64]:
    light_of_object = np.full(len(scene.objects), -1, np.int64)
    rows = list(light_rows(scene))
    light_of_object[rows] = np.arange(len(rows))
    return light_of_object[scene.object_index]


def _with_lights(
    scene: TrainingScene, lights_rgb: NDArray[np.float32] | None, resolution: int
) -> TrainingScene:
    if lights_rgb is None:
        raise TrilightError(
            f"sample {scene.key}: its lights are not kept apart, which light_mix needs. Generate "
            "the dataset with --set renders.per_light=true, or set augmentation.light_mix=1."
        )
    smaller = np.stack([block_mean(lights, resolution) for lights in lights_rgb])
    return dataclasses.replace(scene, lights_VLRR3=torch.from_numpy(smaller))
