"""Scenes of one step -> batches of similar length, so that little work is spent on padding.

A step's scenes are drawn at random, whatever their size; only then are they cut by length. Every
gradient is therefore of a fair mixture, and the loss is a mean over all views of the step, not over
its batches.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.scene_tensors import SceneBatch, batch_scenes, converted
from train.data.scenes import TrainingScene, with_target

MOST_WASTE = 0.05
"""Most extra cost by padding, as a share of what the batch's scenes cost without it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingBatch:
    """Scenes of similar length that are computed together."""

    scenes: SceneBatch
    """What the network reads."""
    target_BVRR3: Tensor
    """log10(1 + radiance); with `levels_BL`, int16 rows of it."""
    noise_BV: Tensor
    """Root mean square noise of the targets."""
    levels_BL: Tensor | None = None
    """As in TrainingScene, of each scene or [1, L] of all; None where targets are looked up."""
    arrived: torch.cuda.Event | None = None
    """When its copy to the card is there; None where it has not been sent ahead."""

    def converted(self, convert: Callable[[Tensor], Tensor]) -> "TrainingBatch":
        """Return the batch with each tensor converted."""
        return dataclasses.replace(
            self,
            scenes=converted(self.scenes, convert),
            target_BVRR3=convert(self.target_BVRR3),
            noise_BV=convert(self.noise_BV),
            levels_BL=None if self.levels_BL is None else convert(self.levels_BL),
        )

    def to(self, device: torch.device) -> "TrainingBatch":
        """Return the batch on a device, with its targets, when its copy is there."""
        if self.arrived is not None:
            stream = torch.cuda.current_stream(device)
            stream.wait_event(self.arrived)
            # their memory belongs to another stream, which must not take it back too early
            self.converted(lambda tensor: _kept_for(tensor, stream))
            return dataclasses.replace(self, arrived=None)._with_targets()
        if device.type == "cpu":
            return self._with_targets()
        return self.converted(lambda tensor: tensor.to(device, non_blocking=True))._with_targets()

    def _with_targets(self) -> "TrainingBatch":
        """Look targets up where that is left to do: the same numbers as `with_target` gives."""
        if self.levels_BL is None:
            return self
        rows_BN = self.target_BVRR3.flatten(1).long()
        target_BN = self.levels_BL.expand(len(rows_BN), -1).gather(1, rows_BN)
        target_BVRR3 = target_BN.view(self.target_BVRR3.shape)
        return dataclasses.replace(self, target_BVRR3=target_BVRR3, levels_BL=None)


def _kept_for(tensor: Tensor, stream: torch.cuda.Stream) -> Tensor:
    tensor.record_stream(stream)
    return tensor


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
    """Stack scenes of equal view count; targets stay rows where all of them are."""
    levels = [scene.levels_L for scene in scenes if scene.levels_L is not None]
    if len(levels) < len(scenes):
        scenes, levels = [with_target(scene) for scene in scenes], []
    if levels and all(each is levels[0] for each in levels):
        levels = levels[:1]
    return TrainingBatch(
        scenes=batch_scenes([scene.tensors for scene in scenes]),
        target_BVRR3=torch.stack([scene.target_VRR3 for scene in scenes]),
        noise_BV=torch.stack([scene.noise_V for scene in scenes]),
        levels_BL=torch.stack(levels) if levels else None,
    )
