"""Device prefetch of a step's scenes: batched ahead in a thread, copied while kernels run.

A CPU needs no copy. A GPU overlaps copies with kernels only from pinned memory and in a separate
stream: the first batch of a step is waited for, the others are copied while it is computed.
"""

import dataclasses
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

import torch

from train.data.buckets import TrainingBatch, bucket_scenes
from train.data.scenes import TrainingScene
from train.data.stream import prefetch

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


def decodes_on_device(device: torch.device) -> bool:
    """Return whether targets are looked up on the device, which saves work of decoding threads."""
    return device.type == "cuda"


def step_scenes(
    scenes_per_step: Iterator[list[TrainingScene]],
    cost: Callable[[int], float],
    max_scenes: int,
    device: torch.device,
) -> Generator[StepScenes, None, None]:
    """Yield the batches of each step, made ahead in a thread; closing it ends the thread.

    Args:
        scenes_per_step: scenes of each step.
        cost: as in `bucket_scenes`.
        max_scenes: as in `bucket_scenes`.
        device: device of the network.
    """
    pins = _has_streams(device)
    return prefetch(
        (_make_step_scenes(scenes, cost, max_scenes, pins) for scenes in scenes_per_step), _AHEAD
    )


def _make_step_scenes(
    scenes: Sequence[TrainingScene], cost: Callable[[int], float], max_scenes: int, pins: bool
) -> StepScenes:
    batches = bucket_scenes(scenes, cost, max_scenes)
    if pins:
        batches = [batch.map_tensors(torch.Tensor.pin_memory) for batch in batches]
    return StepScenes(
        batches=batches,
        keys=tuple(scene.key for scene in scenes),
        num_triangles=tuple(scene.tensors.num_triangles for scene in scenes),
    )


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
                copied = batch.map_tensors(
                    lambda tensor: tensor.to(self._device, non_blocking=True)
                )
                sent.append(dataclasses.replace(copied, arrived=self._stream.record_event()))
        return sent


def _has_streams(device: torch.device) -> bool:
    return device.type == "cuda" and torch.backends.cuda.is_built()
