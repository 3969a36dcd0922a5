"""Synthetic batch of a training preset's size, since the content does not change the time."""

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from infra.bench.workloads.cost_scene import cost_scene
from model.costs import Workload
from model.scene_tensors import SceneTensors, batch_scenes, scene_tensors
from storage.conventions import look_at_c2w
from train.data.buckets import TrainingBatch
from train.loss.lpips import BLOCKS, Lpips
from train.settings import TrainSettings

if TYPE_CHECKING:
    from model.config import ModelConfig

_LIGHTS = 4
UNSTATED_TRIANGLES = 1024
"""Triangles of the longest scene if a preset sets no limit."""

SPREAD = 0.06
"""Fraction by which the shortest scene of a pass is shorter than the longest, as in the buckets of
`pretrain`. Half of it is padding on average, so that attention has a mask."""

VGG16_WIDTHS = (64, 128, 256, 512, 512)
"""Channels of VGG16's blocks, as in the published LPIPS."""


def workloads(settings: TrainSettings, scenes: int) -> list[Workload]:
    """Return the scenes of a pass, longest first."""
    longest = settings.most_triangles or UNSTATED_TRIANGLES
    return [
        Workload(
            triangles=round(longest * (1 - SPREAD * row / max(scenes - 1, 1))),
            views=settings.views_per_scene,
            resolution=settings.resolution,
        )
        for row in range(scenes)
    ]


def scene_of(workload: Workload) -> SceneTensors:
    """Return two objects in a room with an exact number of triangles, and cameras around them."""
    scene = cost_scene(math.ceil(1.3 * workload.triangles) + 32, _LIGHTS)
    poses = [
        look_at_c2w(
            eye=(1.4 + math.cos(6 * angle), math.sin(6 * angle) - 2.2, 1.3),
            target=(0, 0, 0.35),
            up=(0, 0, 1),
        )
        for angle in np.linspace(0, 1, workload.views, endpoint=False)
    ]
    tensors = scene_tensors(
        scene.with_cameras(
            np.stack(poses).astype(np.float32), np.full(workload.views, 40.0, np.float32)
        )
    )
    # rows spread over the scene, the room first and the lights last
    rows = torch.linspace(0, tensors.num_triangles - 1, workload.triangles).round().long()
    return SceneTensors(
        triangles_T33=tensors.triangles_T33[rows],
        normals_T33=tensors.normals_T33[rows],
        material_TM=tensors.material_TM[rows],
        c2w_V44=tensors.c2w_V44,
        fov_deg_V=tensors.fov_deg_V,
    )


def drawn_batch(settings: TrainSettings, scenes: int) -> TrainingBatch:
    """Return a batch on the processor: scenes of real geometry, with noise as targets."""
    generator = torch.Generator().manual_seed(0)
    views = settings.views_per_scene
    px = settings.resolution
    return TrainingBatch(
        scenes=batch_scenes(
            [_prepare(scene_of(each), settings.model, px) for each in workloads(settings, scenes)]
        ),
        target_BVRR3=0.3 * torch.rand(scenes, views, px, px, 3, generator=generator),
        noise_BV=torch.full((scenes, views), 1e-3),
    )


def _prepare(tensors: SceneTensors, model: "ModelConfig", px: int) -> SceneTensors:
    """Return a scene with the inputs of its network, as the stream does."""
    if not model.hit_rays:
        return tensors
    from model.demodulated import with_albedo
    from model.hits.tracing import with_traced

    if model.demodulated:
        return with_albedo(tensors, px, model.hit_rays)
    return with_traced(tensors, px, model, 0)


def drawn_lpips(settings: TrainSettings, widths: tuple[int, ...] = VGG16_WIDTHS) -> Lpips | None:
    """Return LPIPS with random weights of the published sizes; None if a preset has no LPIPS."""
    if settings.loss.perceptual != "lpips":
        return None
    vgg16 = {}
    linear = {}
    channels = 3
    generator = torch.Generator().manual_seed(0)
    for block, (numbers, width) in enumerate(zip(BLOCKS, widths, strict=True)):
        for number in numbers:
            spread = (2 / (9 * channels)) ** 0.5
            weight = spread * torch.randn(width, channels, 3, 3, generator=generator)
            vgg16[f"features.{number}.weight"] = weight
            vgg16[f"features.{number}.bias"] = torch.zeros(width)
            channels = width
        linear[f"lin{block}.model.1.weight"] = torch.rand(1, width, 1, 1, generator=generator)
    return Lpips(vgg16, linear)
