"""Shards -> an endless stream of training scenes, decoded in a background thread.

Position p of the stream is the same scene with the same augmentation whoever asks and wherever the
stream was entered, so a run resumes by its step number alone.
"""

import itertools
import queue
import threading
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from storage.dataset import Dataset
from storage.manifest import ShardEntry
from storage.sample import Sample
from storage.seeds import rng_for
from train.data.augment import augmented, with_views
from train.data.order import EpochOrder, Place, epoch_order
from train.data.scenes import TrainingScene, training_scene

PREFETCHED_SCENES = 16
"""Scenes decoded ahead of the network."""


@dataclass(frozen=True, kw_only=True)
class StreamSettings:
    """What the stream depends on."""

    seed: int
    """Seed of the order."""
    window: int
    """Samples in memory to shuffle among."""
    resolution: int
    """Pixels across the pictures."""
    views_per_scene: int
    """Views that are drawn of each scene."""


def stream_scenes(
    dataset: Dataset, shards: Sequence[ShardEntry], settings: StreamSettings, first: int
) -> Iterator[TrainingScene]:
    """Yield the scenes at positions first, first + 1, ... without end.

    Raises:
        TrilightError: a shard is missing or damaged; when it is reached.
    """
    num_samples = [shard.num_samples for shard in shards]
    samples = _endless_samples(dataset, shards, num_samples, settings, first)
    for position, sample in enumerate(samples, start=first):
        scene = training_scene(sample, settings.resolution)
        rng = rng_for(settings.seed, "visit", position)
        views = rng.permutation(len(scene.target_VRR3))[: settings.views_per_scene]
        yield augmented(with_views(scene, np.sort(views)), rng)


def _endless_samples(
    dataset: Dataset,
    shards: Sequence[ShardEntry],
    num_samples: Sequence[int],
    settings: StreamSettings,
    first: int,
) -> Iterator[Sample]:
    first_epoch, within = divmod(first, sum(num_samples))
    for epoch in itertools.count(first_epoch):
        order = epoch_order(num_samples, seed=settings.seed, epoch=epoch, window=settings.window)
        yield from _read_in_order(dataset, shards, order, order.places[within:])
        within = 0


def _read_in_order(
    dataset: Dataset, shards: Sequence[ShardEntry], order: EpochOrder, places: Sequence[Place]
) -> Iterator[Sample]:
    """Yield the samples at `places`; no shard is opened of which none is wanted."""
    wanted = set(places)
    waiting: dict[Place, Sample] = {}
    arrivals = (
        ((shard, row), sample)
        for shard in order.shards
        if any((shard, row) in wanted for row in range(shards[shard].num_samples))
        for row, sample in enumerate(dataset.read_shard(shards[shard]))
    )
    for place in places:
        while place not in waiting:
            arrived, sample = next(arrivals)
            if arrived in wanted:
                waiting[arrived] = sample
        yield waiting.pop(place)


def prefetched(scenes: Iterator[TrainingScene]) -> Generator[TrainingScene, None, None]:
    """Yield the same scenes, made ahead in a thread; an error arrives at its place in the stream.

    Closing the returned iterator ends the thread.
    """
    ready: queue.Queue[TrainingScene | BaseException | None] = queue.Queue(PREFETCHED_SCENES)
    closed = threading.Event()
    worker = threading.Thread(target=_fill, args=(scenes, ready, closed), daemon=True)
    worker.start()
    try:
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        closed.set()
        with suppress(queue.Empty):
            while True:
                ready.get_nowait()
        worker.join()


def _fill(
    scenes: Iterator[TrainingScene],
    ready: "queue.Queue[TrainingScene | BaseException | None]",
    closed: threading.Event,
) -> None:
    item: TrainingScene | BaseException | None
    while not closed.is_set():
        try:
            item = next(scenes, None)
        except Exception as error:
            item = error
        while not closed.is_set():
            with suppress(queue.Full):
                ready.put(item, timeout=0.1)
                break
        if not isinstance(item, TrainingScene):
            return
