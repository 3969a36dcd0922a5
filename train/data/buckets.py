"""Scenes of one step -> batches of about one length, so that little is spent on padding.

A step's scenes are drawn at random, whatever their size; only then are they cut by length. Every
gradient is therefore of a fair mixture, and the loss is a mean over all views of the step, not over
its batches.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.scene_tensors import SceneBatch, batch_scenes
from train.data.scenes import TrainingScene

LONGEST_TO_SHORTEST = 1.5
"""Within one batch. 1 would pad nothing, but make many small products; 3 buckets are typical."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingBatch:
    """Scenes that are worth computing together."""

    scenes: SceneBatch
    """What the network reads."""
    target_BVRR3: Tensor
    """log10(1 + radiance)."""


def bucket_scenes(scenes: Sequence[TrainingScene]) -> list[TrainingBatch]:
    """Return batches, shortest first, that hold each scene once."""
    by_length = sorted(scenes, key=lambda scene: scene.tensors.num_triangles)
    buckets: list[list[TrainingScene]] = []
    for scene in by_length:
        limit = LONGEST_TO_SHORTEST * buckets[-1][0].tensors.num_triangles if buckets else 0
        if scene.tensors.num_triangles <= limit:
            buckets[-1].append(scene)
        else:
            buckets.append([scene])
    return [make_batch(bucket) for bucket in buckets]


def make_batch(scenes: Sequence[TrainingScene]) -> TrainingBatch:
    """Stack scenes of equal view count."""
    return TrainingBatch(
        scenes=batch_scenes([scene.tensors for scene in scenes]),
        target_BVRR3=torch.stack([scene.target_VRR3 for scene in scenes]),
    )
