"""Batches of scenes of similar length within a step, to reduce padding, and their way to a GPU.

A step's scenes are drawn at random, independent of their size, and only then grouped by length.
Every gradient is therefore an unbiased mixture, and the loss is a mean over all views of the step,
not over its batches.

Batches are made ahead in a thread, and copied while kernels run. A CPU needs no copy. A GPU
overlaps copies with kernels only from pinned memory and in a separate stream: the first batch of a
step is waited for, the others are copied while it is computed.
"""

import dataclasses
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from model.scene_tensors import SceneBatch, batch_scenes, map_tensors
from train.data.loader import prefetch
from train.data.scenes import TrainingScene

MOST_WASTE = 0.05
"""Maximum extra cost by padding, as a fraction of the cost of the scenes without it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingBatch:
    """Scenes of similar length that are computed together."""

    scenes: SceneBatch
    """Input of the network, padded to the longest scene."""
    target_BVRR3: Tensor
    """log10(1 + radiance) of the pictures of each view."""
    noise_BV: Tensor
    """Root mean square noise of the targets in log10(1 + radiance)."""
    arrived: torch.cuda.Event | None = None
    """Event at the end of the copy to the GPU; None if no copy was started."""

    def to(self, device: torch.device) -> "TrainingBatch":
        """Return the batch on a device; waits for a copy that was started."""
        if self.arrived is not None:
            stream = torch.cuda.current_stream(device)
            stream.wait_event(self.arrived)
            # the memory belongs to another stream, which must not reuse it too early
            map_tensors(self, lambda tensor: _record_use(tensor, stream))
            return dataclasses.replace(self, arrived=None)
        return map_tensors(self, lambda tensor: tensor.to(device, non_blocking=True))


def _record_use(tensor: Tensor, stream: torch.cuda.Stream) -> Tensor:
    tensor.record_stream(stream)
    return tensor


def bucket_scenes(
    scenes: Sequence[TrainingScene], cost: Callable[[int], float], max_scenes: int
) -> list[TrainingBatch]:
    """Return batches, shortest first, that hold each scene once.

    Args:
        scenes: scenes of equal view count.
        cost: cost of a scene by its number of triangles (model.costs), increasing.
        max_scenes: maximum number of scenes in a batch.
    """
    by_length = sorted(scenes, key=lambda scene: scene.tensors.num_triangles)
    buckets: list[list[TrainingScene]] = []
    unpadded_cost = 0.0
    for scene in by_length:
        scene_cost = cost(scene.tensors.num_triangles)
        if buckets and len(buckets[-1]) < max_scenes:
            padded_cost = (len(buckets[-1]) + 1) * scene_cost
            if padded_cost <= (1 + MOST_WASTE) * (unpadded_cost + scene_cost):
                buckets[-1].append(scene)
                unpadded_cost += scene_cost
                continue
        buckets.append([scene])
        unpadded_cost = scene_cost
    return [collate_batch(bucket) for bucket in buckets]


def collate_batch(scenes: Sequence[TrainingScene]) -> TrainingBatch:
    """Collate scenes of equal view count."""
    return TrainingBatch(
        scenes=batch_scenes([scene.tensors for scene in scenes]),
        target_BVRR3=torch.stack([scene.target_VRR3 for scene in scenes]),
        noise_BV=torch.stack([scene.noise_V for scene in scenes]),
    )


_AHEAD = 1
"""Number of steps that are batched ahead."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StepScenes:
    """Batches of one step of this process."""

    batches: list[TrainingBatch]
    """Batches of scenes of similar length, each scene once."""
    keys: tuple[str, ...]
    """Sample keys of the step's scenes, in the order they were drawn."""
    num_triangles: tuple[int, ...]
    """Number of triangles of each scene, in the same order."""


def step_scenes(
    scenes_per_step: Iterator[list[TrainingScene]],
    cost: Callable[[int], float],
    max_scenes: int,
    device: torch.device,
) -> Generator[StepScenes, None, None]:
    """Yield the batches of each step, made ahead in a thread; closing it ends the thread."""
    pins = _has_streams(device)

    def make(scenes: list[TrainingScene]) -> StepScenes:
        batches = bucket_scenes(scenes, cost, max_scenes)
        if pins:
            batches = [map_tensors(batch, Tensor.pin_memory) for batch in batches]
        return StepScenes(
            batches=batches,
            keys=tuple(scene.key for scene in scenes),
            num_triangles=tuple(scene.tensors.num_triangles for scene in scenes),
        )

    return prefetch(map(make, scenes_per_step), _AHEAD)


class CopyStream:
    """Copies batches to a GPU while it computes; on the CPU it returns them unchanged."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device) if _has_streams(device) else None

    def send(self, batches: Sequence[TrainingBatch]) -> list[TrainingBatch]:
        """Start copies of pinned batches in order; `TrainingBatch.to` waits for each."""
        if self._stream is None:
            return list(batches)
        sent = []
        with torch.cuda.stream(self._stream):
            for batch in batches:
                copied = map_tensors(batch, lambda each: each.to(self._device, non_blocking=True))
                sent.append(dataclasses.replace(copied, arrived=self._stream.record_event()))
        return sent


def _has_streams(device: torch.device) -> bool:
    return device.type == "cuda" and torch.backends.cuda.is_built()
