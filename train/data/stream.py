"""Shards -> an endless stream of batches of training scenes, fetched and decoded ahead in threads.

Batch i holds the same scenes with the same augmentation wherever the stream was entered, for any
number of ranks and threads: a run resumes by the number of its step.
"""

import dataclasses
import itertools
import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from model.sky.known import require_known, shining
from storage.dataset.shard_set import OpenShard, ShardSet
from storage.errors import TrilightError
from storage.records.stored_sample import StoredSample
from storage.seeds import rng_for
from train.data.augment import augmented, with_inputs_withheld
from train.data.mixture import Mixture, mixed_places
from train.data.open_shards import OpenShards
from train.data.order import (
    OrderSettings,
    Place,
    RankShare,
    batched,
    places_from,
    shard_order,
    windows_from,
)
from train.data.scenes import (
    TrainingScene,
    drawn_scene,
    require_few_triangles,
    with_target,
)
from train.data.unusable import Unusable, lost_with

if TYPE_CHECKING:
    from model.config import ModelConfig
    from train.settings import AugmentationSettings

PREFETCHED_SCENES = 16
"""Scenes decoded ahead of the network, at least one batch."""

Item = TypeVar("Item")


@dataclass(frozen=True, kw_only=True)
class StreamSettings:
    """What the stream depends on."""

    seed: int
    """Seed of the order and of what is drawn at each visit."""
    window: int
    """Shards among whose samples is shuffled."""
    batch_size: int
    """Scenes of a global batch, over all ranks."""
    resolution: int
    """Pixels across the pictures."""
    views_per_scene: int
    """Views that are drawn of each scene."""
    most_triangles: int = 0
    """Samples with more are unusable; 0: none is."""
    augmentation: "AugmentationSettings | None" = None
    """Symmetries that are drawn at each visit; none by default."""
    looked_up: bool = True
    """Whether targets are looked up in the decoding threads, and not where batches arrive."""
    network: "ModelConfig | None" = None
    """The network that is trained: what it wants traced of its views, is traced here."""

    @property
    def order(self) -> OrderSettings:
        return OrderSettings(seed=self.seed, window=self.window)


def stream_batches(
    shards: ShardSet,
    settings: StreamSettings,
    first: int,
    *,
    share: RankShare,
    workers: int,
    unusable: Unusable,
    mixture: Mixture | None = None,
) -> Generator[list[TrainingScene], None, None]:
    """Yield this process's part of the global batches first, first + 1, ... without end.

    Closing the returned iterator ends its threads.

    Args:
        shards: of the train split.
        settings: what decides the order and the scenes.
        first: number of a global batch.
        share: which part of each batch; the ranks' parts are equally large and make up the batch.
        workers: threads that read and decode, 0: the caller's own; what comes out does not depend
            on them.
        mixture: how the parts of the shards are mixed, where these are several datasets.
        unusable: counts damaged data, or stops at it. An unusable sample is replaced by the next
            usable one of its shard, a shard that cannot be opened by the one of the next number.

    Raises:
        TrilightError: the ranks cannot share a batch equally, or data is unusable beyond the limit;
            when it is reached.
    """
    share.require_equal(settings.batch_size)
    pool = ThreadPoolExecutor(workers, "decode") if workers else _CallersThread()
    with OpenShards(shards) as opened, pool as decoders:
        maker = _SceneMaker(shards, opened, settings, unusable)
        counted = _Counted(shards, unusable)
        plan = _planned(counted, settings, mixture, first, share, opened)
        waiting: deque[tuple[list[Place], list[Future[TrainingScene]]]] = deque()
        depth = -(-PREFETCHED_SCENES * share.world_size // settings.batch_size) if workers else 0
        try:
            with closing(prefetched(plan, _plan_ahead(counted, settings, mixture))) as batches:
                for mine in batches:
                    waiting.append((mine, [decoders.submit(maker.scene, p) for p in mine]))
                    if len(waiting) > depth:
                        places, scenes = waiting.popleft()
                        ready = [scene.result() for scene in scenes]
                        opened.done(place.shard for place in places)
                        yield ready
        finally:
            decoders.shutdown(wait=True, cancel_futures=True)


class _CallersThread(Executor):
    """Does at once what it is asked."""

    def submit(
        self, function: Callable[..., Item], /, *arguments: Any, **named: Any
    ) -> Future[Item]:
        done: Future[Item] = Future()
        try:
            done.set_result(function(*arguments, **named))
        except Exception as error:
            done.set_exception(error)
        return done


class _Counted:
    """The parts of a set, with the sizes of their shards; an unusable one has no sample."""

    def __init__(self, shards: ShardSet, unusable: Unusable) -> None:
        self._shards = shards
        self._unusable = unusable
        self.parts = shards.parts

    def in_part(self, part: range) -> Callable[[int], int]:
        """Return a function that counts the samples of a shard by its number in a part."""
        return lambda number: self._count(part.start + number)

    def _count(self, number: int) -> int:
        try:
            return self._shards.num_samples(number)
        except TrilightError as error:
            self._unusable.add(self._shards.names[number], 1, error)
            return 0


def _planned(
    counted: _Counted,
    settings: StreamSettings,
    mixture: Mixture | None,
    first: int,
    share: RankShare,
    opened: OpenShards,
) -> Iterator[list[Place]]:
    """Yield this process's places batch by batch, and have their shards opened."""
    position = first * settings.batch_size
    begin = (position,) if mixture is None else mixture.taken(position)
    streams = [
        places_from(windows_from(len(part), counted.in_part(part), settings.order, start), start)
        for part, start in zip(counted.parts, begin, strict=True)
    ]
    if mixture is None:
        places = streams[0]
    else:
        places = mixed_places(mixture, streams, counted.parts, position)
    for batch in batched(places, settings.batch_size):
        mine = share.of_batch(batch)
        opened.plan(place.shard for place in mine)
        yield mine


def _plan_ahead(counted: _Counted, settings: StreamSettings, mixture: Mixture | None) -> int:
    """Return how many batches to plan ahead: about a window, so that the next shards are opened.

    Of several datasets, the window that is through first.
    """
    weights = (1.0,) if mixture is None else mixture.weights
    ahead = []
    for part, weight in zip(counted.parts, weights, strict=True):
        some = shard_order(len(part), settings.order, 0)[0]
        window = counted.in_part(part)(some) * settings.window
        ahead.append(int(window * sum(weights) / weight) // settings.batch_size)
    return max(min(ahead), 1)


class _SceneMaker:
    """Makes the scene of a place; called in several threads."""

    def __init__(
        self, shards: ShardSet, opened: OpenShards, settings: StreamSettings, unusable: Unusable
    ) -> None:
        self._shards = shards
        self._opened = opened
        self._settings = settings
        self._unusable = unusable
        self._given_up: set[int] = set()

    def scene(self, place: Place) -> TrainingScene:
        """Return the scene that is seen at a place of the order."""
        settings = self._settings
        seen, rng = self._usable(place)
        if settings.augmentation:
            seen = augmented(seen, settings.augmentation, rng)
        return self._prepared(with_target(seen) if settings.looked_up else seen, rng)

    def _prepared(self, seen: TrainingScene, rng: np.random.Generator) -> TrainingScene:
        """Return a scene with all that its network wants to be told."""
        settings = self._settings
        if settings.network is None or not settings.network.hit_rays:
            return seen
        # these bring the checker of settings along
        from model.demodulated import with_albedo
        from model.hits.tracing import with_traced

        # after the symmetries, which therefore need not know what is traced
        if settings.network.demodulated:
            tensors = with_albedo(seen.tensors, settings.resolution, settings.network.hit_rays)
            return dataclasses.replace(seen, tensors=tensors)
        noise = int(rng.integers(2**31))
        tensors = with_traced(seen.tensors, settings.resolution, settings.network, noise)
        withheld = settings.augmentation.withheld_inputs if settings.augmentation else 0.0
        return dataclasses.replace(seen, tensors=with_inputs_withheld(tensors, withheld, rng))

    def _usable(self, place: Place) -> tuple[TrainingScene, np.random.Generator]:
        """Return the drawn views of a usable sample, and what else of its visit is drawn from."""
        part = self._shards.parts[place.source]
        after = range(place.shard, part.stop), range(part.start, place.shard)
        for number in itertools.chain(*after):
            if number in self._given_up:
                continue
            planned = number == place.shard
            try:
                shard = self._opened.read(number) if planned else self._shards.open(number)
            except TrilightError as error:
                lost = lost_with(self._shards, number)
                self._unusable.add(self._shards.names[number], lost, error)
                continue
            with nullcontext() if planned else closing(shard):
                found = self._first_usable(shard, place)
            if found is not None:
                return found
            self._given_up.add(number)
        raise TrilightError(
            f"data: no sample of {len(part)} shards is usable. The last that was tried: "
            f"{self._unusable.messages[-1]}"
        )

    def _first_usable(
        self, shard: OpenShard, place: Place
    ) -> tuple[TrainingScene, np.random.Generator] | None:
        """Return the first scene of a shard that is usable, from a row on and around; or None."""
        keys = shard.keys
        for at in ((place.row + step) % len(keys) for step in range(len(keys))):
            rng = rng_for(self._settings.seed, "visit", place.position)
            try:
                return self._drawn(shard.stored_sample(at), rng), rng
            except TrilightError as error:
                named = _named(shard.name, error)
                self._unusable.add(f"{shard.name}: sample {keys[at]}", 1, named)
        return None

    def _drawn(self, sample: StoredSample, rng: np.random.Generator) -> TrainingScene:
        settings, num_views = self._settings, sample.scene.num_views
        if num_views < settings.views_per_scene:
            raise TrilightError(
                f"sample {sample.key}: {num_views} views; the run draws "
                f"{settings.views_per_scene} of each scene."
            )
        require_few_triangles(sample.key, sample.scene, settings.most_triangles)
        if settings.network is not None:
            require_known(shining(sample.scene.environment), settings.network)
        views = np.sort(rng.permutation(num_views)[: settings.views_per_scene])
        lights_apart = settings.augmentation is not None and settings.augmentation.light_mix > 1
        return drawn_scene(sample, views.tolist(), settings.resolution, lights_apart=lights_apart)


def _named(shard: str, error: TrilightError) -> TrilightError:
    text = str(error)
    return error if text.startswith(shard) else TrilightError(f"{shard}: {text}")


def prefetched(items: Iterator[Item], depth: int) -> Generator[Item, None, None]:
    """Yield the same items, made ahead in a thread; an error arrives at its place in the stream.

    Closing the returned iterator ends the thread.

    Args:
        items: what to take them from.
        depth: how many to make ahead.
    """
    ready: queue.Queue[tuple[Item] | BaseException | None] = queue.Queue(depth)
    closed = threading.Event()
    worker = threading.Thread(target=_fill, args=(items, ready, closed), daemon=True)
    worker.start()
    try:
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item[0]
    finally:
        closed.set()
        with suppress(queue.Empty):
            while True:
                ready.get_nowait()
        worker.join()


def _fill(
    items: Iterator[Item],
    ready: "queue.Queue[tuple[Item] | BaseException | None]",
    closed: threading.Event,
) -> None:
    made: tuple[Item] | BaseException | None
    while not closed.is_set():
        try:
            made = (next(items),)
        except StopIteration:
            made = None
        except Exception as error:
            made = error
        while not closed.is_set():
            with suppress(queue.Full):
                ready.put(made, timeout=0.1)
                break
        if not isinstance(made, tuple):
            return
