"""Endless batches of training datasets, decoded by threads, in place of torch's DataLoader.

Batch i holds the same scenes with the same augmentation wherever the stream starts, for any number
of ranks and threads: a run resumes by the number of its step, and every start chooses the number of
threads again, from the free cores and memory of the machine.
"""

import dataclasses
import itertools
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from model.scene_tensors import lit_sky, require_known_sky
from storage.dataset.shard import ShardReader
from storage.dataset.shard_set import ShardSet
from storage.errors import TrilightError
from storage.machine import allowed_cores, free_memory
from storage.records.sample import StoredSample
from storage.seeds import rng_for
from train.data.augment import augment_scene, withhold_inputs
from train.data.bad_samples import BadSampleCounter
from train.data.order import (
    Mixture,
    RankSlice,
    Visit,
    shuffled_shards,
    single_dataset,
    visits_from,
)
from train.data.scenes import TrainingScene, require_few_triangles, scene_of_views

if TYPE_CHECKING:
    from train.settings import TrainSettings


PREFETCHED_SCENES = 16
"""Number of scenes decoded ahead of the network; at least one batch is."""

Item = TypeVar("Item")


def load_batches(
    shards: ShardSet,
    settings: "TrainSettings",
    first: int,
    *,
    rank_slice: RankSlice,
    workers: int,
    unusable: BadSampleCounter,
    mixture: Mixture | None = None,
) -> Generator[list[TrainingScene], None, None]:
    """Yield this process's slice of the global batches first, first + 1, ... without end.

    Closing the returned iterator ends its threads.

    Args:
        first: number of a global batch.
        rank_slice: slice of each batch for this process; all slices have equal size.
        workers: threads that read and decode; with 0 the caller's thread. The result does not
            depend on them.
        mixture: mixture of the datasets, if there are several.
        unusable: counts damaged data, or stops at it. An unusable sample is replaced by the next
            usable one of its shard, a shard that cannot be opened by the one of the next number.

    Raises:
        TrilightError: a batch cannot be split equally, or too much data is unusable; the latter
            when the stream reaches it.
    """
    rank_slice.require_equal(settings.scenes_per_step)
    mixture = mixture or single_dataset("", settings.scenes_per_step)
    with OpenShards(shards) as opened, ThreadPoolExecutor(max(workers, 1), "decode") as decoders:
        maker = _SceneMaker(shards, opened, settings, unusable)
        waiting: deque[tuple[list[Visit], list[Callable[[], TrainingScene]]]] = deque()

        def begin(visit: Visit) -> Callable[[], TrainingScene]:
            make = partial(maker.scene, visit)
            return decoders.submit(make).result if workers else make

        ahead = -(-PREFETCHED_SCENES * rank_slice.world_size // settings.scenes_per_step)
        depth = ahead if workers else 0
        plan = maker.plan_batches(mixture, first, rank_slice)
        try:
            with closing(prefetch(plan, maker.batches_ahead(mixture))) as batches:
                for mine in batches:
                    waiting.append((mine, [begin(visit) for visit in mine]))
                    if len(waiting) > depth:
                        visits, scenes = waiting.popleft()
                        ready = [scene() for scene in scenes]
                        opened.mark_read(visit.shard for visit in visits)
                        yield ready
        finally:
            decoders.shutdown(wait=True, cancel_futures=True)


OPENED_AT_ONCE = 4
"""Maximum number of shards that are fetched and checked at the same time."""


class OpenShards:
    """Open shards of a set, by number. Safe to use from several threads."""

    def __init__(self, shards: ShardSet) -> None:
        self._shards = shards
        self._opening = ThreadPoolExecutor(OPENED_AT_ONCE, thread_name_prefix="open-shard")
        self._open: dict[int, Future[ShardReader]] = {}
        self._planned: Counter[int] = Counter()
        self._lock = threading.Lock()

    def __enter__(self) -> "OpenShards":
        return self

    def __exit__(self, *_: object) -> None:
        """Close all shards; wait for those being opened, whose files must not be left open."""
        self._opening.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            for future in self._open.values():
                _close(future)
            self._open.clear()

    def plan(self, numbers: Iterable[int]) -> None:
        """Start to open the shards of planned samples: one shard number for each sample."""
        with self._lock:
            for number in numbers:
                self._planned[number] += 1
                if number not in self._open:
                    self._open[number] = self._opening.submit(self._shards.open, number)

    def read(self, number: int) -> ShardReader:
        """Return a planned shard after it is open; raises the error of opening it."""
        with self._lock:
            future = self._open[number]
        return future.result()

    def mark_read(self, numbers: Iterable[int]) -> None:
        """Mark samples as read: one shard number for each, as planned."""
        with self._lock:
            self._planned.subtract(numbers)
            for number in [number for number, count in self._planned.items() if not count]:
                del self._planned[number]
                self._open.pop(number).add_done_callback(_close)


def _close(future: Future[ShardReader]) -> None:
    if not future.cancel() and future.exception() is None:
        future.result().close()


class _SceneMaker:
    """Plans the visits of a stream, and makes the scene of each in several threads."""

    def __init__(
        self,
        shards: ShardSet,
        opened: OpenShards,
        settings: "TrainSettings",
        unusable: BadSampleCounter,
    ) -> None:
        self._shards = shards
        self._opened = opened
        self._settings = settings
        self._unusable = unusable
        self._given_up: set[int] = set()

    def plan_batches(
        self, mixture: Mixture, first: int, rank_slice: RankSlice
    ) -> Iterator[list[Visit]]:
        """Yield this process's visits batch by batch, and start to open their shards."""
        batch_size = self._settings.scenes_per_step
        visits = self._visits(mixture, first * batch_size)
        while True:
            mine = rank_slice.of_batch(tuple(itertools.islice(visits, batch_size)))
            self._opened.plan(visit.shard for visit in mine)
            yield mine

    def _visits(self, mixture: Mixture, first: int) -> Iterator[Visit]:
        """Yield the visits of the stream without end, from position `first` on."""
        seed = self._settings.seed
        window = self._settings.shuffle_shards
        parts = self._shards.parts
        counts, sources = mixture.order_from(first)
        streams = [
            visits_from(len(part), partial(self._count, part), start, seed=seed, window=window)
            for part, start in zip(parts, counts, strict=True)
        ]
        for position, source in enumerate(sources, first):
            visit = next(streams[source])
            shard = parts[source].start + visit.shard
            yield dataclasses.replace(visit, position=position, shard=shard, source=source)

    def batches_ahead(self, mixture: Mixture) -> int:
        """Return the number of batches to plan ahead: about a window, to open its shards in time.

        With several datasets it is the window that ends first.
        """
        settings = self._settings
        ahead = []
        for part, weight in zip(self._shards.parts, mixture.weights, strict=True):
            first = shuffled_shards(len(part), settings.seed, 0)[0]
            window = self._count(part, first) * settings.shuffle_shards
            ahead.append(int(window * sum(mixture.weights) / weight) // settings.scenes_per_step)
        return max(min(ahead), 1)

    def _count(self, part: range, number: int) -> int:
        """Return the size of a dataset's shard; an unusable one counts as empty."""
        number += part.start
        try:
            return self._shards.num_samples(number)
        except TrilightError as error:
            self._unusable.add(self._shards.names[number], 1, error)
            return 0

    def scene(self, visit: Visit) -> TrainingScene:
        """Return the augmented scene of a visit."""
        from model.hits.tracing import with_traced  # it loads pydantic

        settings = self._settings
        seen, rng = self._usable_scene(visit)
        seen = augment_scene(seen, settings.augmentation, rng)
        # after the augmentation, which therefore need not transform traced inputs
        noise = int(rng.integers(2**31))
        tensors = with_traced(seen.tensors, settings.resolution, settings.model, noise)
        withheld = settings.augmentation.withheld_inputs
        return dataclasses.replace(seen, tensors=withhold_inputs(tensors, withheld, rng))

    def _usable_scene(self, visit: Visit) -> tuple[TrainingScene, np.random.Generator]:
        """Return the drawn views of a usable sample, and the random generator of the visit."""
        part = self._shards.parts[visit.source]
        after = range(visit.shard, part.stop), range(part.start, visit.shard)
        for number in itertools.chain(*after):
            if number in self._given_up:
                continue
            planned = number == visit.shard
            try:
                shard = self._opened.read(number) if planned else self._shards.open(number)
            except TrilightError as error:
                self._unusable.add_shard(self._shards, number, error)
                continue
            with nullcontext() if planned else closing(shard):
                usable = self._first_usable(shard, visit)
            if usable is not None:
                return usable
            self._given_up.add(number)
        raise TrilightError(
            f"data: no sample of {len(part)} shards is usable. The last that was tried: "
            f"{self._unusable.messages[-1]}"
        )

    def _first_usable(
        self, shard: ShardReader, visit: Visit
    ) -> tuple[TrainingScene, np.random.Generator] | None:
        """Return the first usable scene of a shard, from the visit's row on cyclically, or None."""
        keys = shard.keys
        for at in ((visit.row + step) % len(keys) for step in range(len(keys))):
            rng = rng_for(self._settings.seed, "visit", visit.position)
            try:
                return self._draw_views(shard.stored_sample(at), rng), rng
            except TrilightError as error:
                if not str(error).startswith(shard.name):
                    error = TrilightError(f"{shard.name}: {error}")
                self._unusable.add(f"{shard.name}: sample {keys[at]}", 1, error)
        return None

    def _draw_views(self, sample: StoredSample, rng: np.random.Generator) -> TrainingScene:
        settings = self._settings
        num_views = sample.scene.num_views
        if num_views < settings.views_per_scene:
            raise TrilightError(
                f"sample {sample.key}: {num_views} views; the run draws "
                f"{settings.views_per_scene} of each scene."
            )
        require_few_triangles(sample.key, sample.scene, settings.most_triangles)
        require_known_sky(lit_sky(sample.scene.environment), settings.model)
        views = np.sort(rng.permutation(num_views)[: settings.views_per_scene])
        per_light = settings.augmentation.light_mix > 1
        return scene_of_views(sample, views.tolist(), settings.resolution, per_light=per_light)


def prefetch(items: Iterator[Item], depth: int) -> Generator[Item, None, None]:
    """Yield the same items, computed ahead in a thread; errors keep their position.

    Closing the returned iterator ends the thread.

    Args:
        depth: maximum number of items to compute ahead.
    """
    end: Any = object()
    with ThreadPoolExecutor(1, "prefetch") as thread:
        ahead = deque(thread.submit(next, items, end) for _ in range(depth + 1))
        try:
            while (item := ahead.popleft().result()) is not end:
                ahead.append(thread.submit(next, items, end))
                yield item
        finally:
            thread.shutdown(cancel_futures=True)


MAX_THREADS = 8
"""Maximum number of threads; more would wait for Python's lock. When threads only decode, two to
three saturate it (study S56); tracing for the view stage `hits` releases it."""

SCENES_AT_WORK = 4
"""Memory of a thread, in scenes as a batch holds them: decoded and waiting ones."""

_BYTES_OF_PIXEL = 12


def choose_workers(
    settings: "TrainSettings", *, on_gpu: bool, busy_threads: int, root: Path = Path("/")
) -> tuple[int, str]:
    """Return the number of decoding threads, 1 or more, and its reason as a sentence.

    The processes of a run on this node share its cores and its free memory.

    Args:
        settings: settings of the run, which determine the memory of its scenes.
        on_gpu: True if the network is on a GPU, for which the main thread needs a core.
        busy_threads: CPU threads of a network that is not on a GPU.
        root: root of the file system, which tells cores and memory.
    """
    cores = allowed_cores(root)
    free_bytes = free_memory(root)
    processes = max(int(os.environ.get("LOCAL_WORLD_SIZE", "1")), 1)
    spare = cores / processes - (1 if on_gpu else busy_threads)
    threads = min(max(int(spare), 1), MAX_THREADS)
    reason = f"{cores:g} cores"
    if processes > 1:
        reason += f" for {processes} processes"
    if free_bytes is not None:
        scene = _BYTES_OF_PIXEL * settings.views_per_scene * settings.resolution**2
        fits = free_bytes // 2 // processes // (SCENES_AT_WORK * scene)
        if fits < threads:
            threads = max(fits, 1)
            reason += f" and {free_bytes / 2**30:.1f} GiB of free memory"
    decision = "1 thread decodes" if threads == 1 else f"{threads} threads decode"
    return threads, f"{decision} samples, by {reason}"
