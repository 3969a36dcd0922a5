"""The way of a step's scenes to the network: batched ahead in a thread, copied beside the kernels.

On the CPU there is no way to go. A card copies beside its kernels only from memory that the system
does not move (pinned), and in a stream of its own: the first batch of a step is waited for, the
others arrive while it is computed.
"""

import dataclasses
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

import torch

from train.data.buckets import TrainingBatch, bucket_scenes
from train.data.scenes import TrainingScene
from train.data.stream import prefetched

_AHEAD = 1
"""Steps that are batched ahead."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StepScenes:
    """The scenes of one step of this process."""

    batches: list[TrainingBatch]
    """All of them, those of similar length together."""
    keys: tuple[str, ...]
    """Keys of their samples."""
    num_triangles: tuple[int, ...]
    """How large they are, in the same order."""


def looks_up_itself(device: torch.device) -> bool:
    """Return whether a device looks targets up by itself, which spares the decoding threads."""
    return device.type == "cuda"


def step_scenes(
    drawn: Iterator[list[TrainingScene]],
    cost: Callable[[int], float],
    most: int,
    device: torch.device,
) -> Generator[StepScenes, None, None]:
    """Yield the scenes of each step, batched ahead in a thread; closing it ends the thread.

    Args:
        drawn: the scenes of each step.
        cost: as in `bucket_scenes`.
        most: as in `bucket_scenes`.
        device: where they will be wanted.
    """
    pins = _has_streams(device)
    return prefetched((_batched(scenes, cost, most, pins) for scenes in drawn), _AHEAD)


def _batched(
    scenes: Sequence[TrainingScene], cost: Callable[[int], float], most: int, pins: bool
) -> StepScenes:
    batches = bucket_scenes(scenes, cost, most)
    if pins:
        batches = [batch.converted(torch.Tensor.pin_memory) for batch in batches]
    return StepScenes(
        batches=batches,
        keys=tuple(scene.key for scene in scenes),
        num_triangles=tuple(scene.tensors.num_triangles for scene in scenes),
    )


class CopyStream:
    """Sends batches to a card beside what it computes; to the CPU they are there already."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._stream = torch.cuda.Stream(device) if _has_streams(device) else None

    def send(self, batches: Sequence[TrainingBatch]) -> list[TrainingBatch]:
        """Begin to copy pinned batches, one after the other; each `to` waits for its own."""
        if self._stream is None:
            return list(batches)
        sent = []
        with torch.cuda.stream(self._stream):
            for batch in batches:
                there = batch.converted(lambda tensor: tensor.to(self._device, non_blocking=True))
                sent.append(dataclasses.replace(there, arrived=self._stream.record_event()))
        return sent


def _has_streams(device: torch.device) -> bool:
    return device.type == "cuda" and torch.backends.cuda.is_built()
