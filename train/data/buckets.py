"""Scenes of one step -> batches of similar length, so that little work is spent on padding.

A step's scenes are drawn at random, whatever their size; only then are they cut by length. Every
gradient is therefore of a fair mixture, and the loss is a mean over all views of the step, not over
its batches.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.scene_tensors import SceneBatch, batch_scenes, converted
from train.data.scenes import TrainingScene

MOST_WASTE = 0.05
"""Most extra cost by padding, as a share of what the batch's scenes cost without it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingBatch:
    """Scenes of similar length that are computed together."""

    scenes: SceneBatch
    """What the network reads."""
    target_BVRR3: Tensor
    """log10(1 + radiance)."""
    noise_BV: Tensor
    """Root mean square noise of the targets."""

    def to(self, device: torch.device) -> "TrainingBatch":
        """Return the batch on a device."""
        if device.type == "cpu":
            return self
        return TrainingBatch(
            scenes=converted(self.scenes, lambda tensor: tensor.to(device, non_blocking=True)),
            target_BVRR3=self.target_BVRR3.to(device, non_blocking=True),
            noise_BV=self.noise_BV.to(device, non_blocking=True),
        )


def bucket_scenes(
    scenes: Sequence[TrainingScene], cost: Callable[[int], float], most: int
) -> list[TrainingBatch]:
    """Return batches, shortest first, that hold each scene once.

    Args:
        scenes: of equal view count.
        cost: what a scene of so many triangles costs (model.costs); it grows with them.
        most: scenes of a batch.
    """
    by_length = sorted(scenes, key=lambda scene: scene.tensors.num_triangles)
    buckets: list[list[TrainingScene]] = []
    alone = 0.0
    for scene in by_length:
        of_scene = cost(scene.tensors.num_triangles)
        if buckets and len(buckets[-1]) < most:
            together = (len(buckets[-1]) + 1) * of_scene
            if together <= (1 + MOST_WASTE) * (alone + of_scene):
                buckets[-1].append(scene)
                alone += of_scene
                continue
        buckets.append([scene])
        alone = of_scene
    return [make_batch(bucket) for bucket in buckets]


def make_batch(scenes: Sequence[TrainingScene]) -> TrainingBatch:
    """Stack scenes of equal view count."""
    return TrainingBatch(
        scenes=batch_scenes([scene.tensors for scene in scenes]),
        target_BVRR3=torch.stack([scene.target_VRR3 for scene in scenes]),
        noise_BV=torch.stack([scene.noise_V for scene in scenes]),
    )
