"""Training scenes: the tensors of a sample for one step.

Most targets are half floats at the resolution of the run, with 31,744 possible values, whose
logarithms are computed once and looked up per pixel.
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
from storage.records.exr import FIRST_ILLEGAL, HALF_FLOATS, Stored, to_float32
from storage.records.lights import light_rows
from storage.records.sample import Sample, StoredSample, ViewRecord
from storage.records.scene import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingScene:
    """One scene and the target pictures of its cameras."""

    key: str
    """Key of the sample in its shard."""
    tensors: SceneTensors
    """Input of the network for this scene."""
    target_VRR3: Tensor
    """float32 log10(1 + radiance), one picture per camera in `tensors`."""
    noise_V: Tensor
    """float32 root mean square noise of the stored pictures in log10(1 + radiance); downsampled
    pictures have less."""
    light_T: Tensor
    """int64 index of each triangle's light (storage.records.lights), -1 for none."""
    lights_VLRR3: Tensor | None = None
    """float32 linear radiance of each light alone, if requested, the sky's last; their sum is the
    picture."""


def training_scene(sample: Sample, resolution: int, *, lights_apart: bool = False) -> TrainingScene:
    """Return a sample at the resolution of the run.

    Args:
        sample: sample that passes `Sample.check`.
        resolution: width of the pictures in pixels.
        lights_apart: True to include the pictures of each light.

    Raises:
        TrilightError: the resolution does not divide the sample's, or the scene has no pictures of
            single lights.
    """
    scene = _scene_of(sample.key, sample.scene, sample.views, sample.radiance_rgb, resolution)
    return _with_lights(scene, sample.lights_rgb, resolution) if lights_apart else scene


def scene_of_views(
    sample: StoredSample, views: Sequence[int], resolution: int, *, per_light: bool = False
) -> TrainingScene:
    """Return some views of a sample; its other pictures are not unpacked.

    Args:
        views: indices of its cameras, at least one.

    Raises:
        TrilightError: a picture is damaged or invalid; otherwise as `training_scene`.
    """
    pictures = sample.pictures(views)
    rows = list(views)
    scene = dataclasses.replace(
        sample.scene, c2w=sample.scene.c2w[rows], fov_deg=sample.scene.fov_deg[rows]
    )
    records = [sample.views[row] for row in rows]
    training = _scene_of(sample.key, scene, records, pictures, resolution)
    if not per_light:
        return training
    return _with_lights(training, sample.lights_rgb(views, pictures.shape[1]), resolution)


def require_few_triangles(key: str, scene: Scene, most: int) -> None:
    """Raise TrilightError if a scene has more than `most` triangles; 0 sets no limit."""
    if 0 < most < scene.num_triangles:
        raise TrilightError(
            f"sample {key}: {scene.num_triangles} triangles; the run takes at most {most}. Set "
            "most_triangles, or skip such samples."
        )


@cache
def stored_levels() -> NDArray[np.float32]:
    """Return the table [31744] of log10(1 + x) by the bits of a half float x."""
    levels: NDArray[np.float32] = log10_radiance(HALF_FLOATS[:FIRST_ILLEGAL]).astype(np.float32)
    return levels


def _scene_of(
    key: str, scene: Scene, views: Sequence[ViewRecord], pictures: Stored, resolution: int
) -> TrainingScene:
    """Return a scene with the pictures of all of its cameras."""
    if pictures.dtype == np.uint16 and pictures.shape[1] == resolution:
        # the bits were validated: mode "clip" avoids another range check, which would copy
        target_VRR3 = np.take(stored_levels(), pictures.view(np.uint16), mode="clip")
    else:
        radiance_VRR3 = block_mean(to_float32(pictures), resolution)
        target_VRR3 = log10_radiance(radiance_VRR3).astype(np.float32)
    light_of_object = np.full(len(scene.objects), -1, np.int64)
    rows = list(light_rows(scene))
    light_of_object[rows] = np.arange(len(rows))
    floors_db = np.array([view.noise_floor_db for view in views], np.float32)
    return TrainingScene(
        key=key,
        tensors=scene_tensors(scene),
        target_VRR3=torch.from_numpy(target_VRR3),
        noise_V=torch.from_numpy(10 ** (-floors_db / 20)),
        light_T=torch.from_numpy(light_of_object[scene.object_index]),
    )


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


def block_mean(radiance_rgb: NDArray[np.float32], resolution: int) -> NDArray[np.float32]:
    """Return pictures [V, R, R, 3] as [V, resolution, resolution, 3], exact up to rounding.

    Raises:
        TrilightError: `resolution` does not divide the pictures' own.
    """
    views, stored = radiance_rgb.shape[:2]
    if resolution < 1 or stored % resolution:
        raise TrilightError(
            f"resolution {resolution}: expected a divisor of {stored}, the resolution of the "
            "dataset. Choose one, or generate the dataset at another resolution."
        )
    factor = stored // resolution
    if factor == 1:
        return radiance_rgb
    # rows first: 4 times faster than both axes at once, which walk memory in small strides
    rows = radiance_rgb.reshape(views, resolution, factor, stored, 3).sum(axis=2, dtype=np.float32)
    blocks = rows.reshape(views, resolution, resolution, factor, 3).sum(axis=3, dtype=np.float32)
    return blocks / np.float32(factor**2)
