"""Shuffled order of a run's scenes: a pure function of seed, epoch and sizes of the shards.

Shards are shuffled; then the samples of each window of a few consecutive shards are shuffled.
Epochs follow one another without a gap, and global batch i is the samples at positions i B to
(i + 1) B - 1 of that endless order, for any number of ranks and workers. A resume needs only the
number of the batch.

A batch is split over the ranks by shard, so that each rank reads few shards of a window.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from storage.errors import TrilightError
from storage.seeds import rng_for


@dataclass(frozen=True, kw_only=True, slots=True)
class Visit:
    """One sample at one position of the order."""

    position: int
    """Position in the endless order; it seeds the augmentation of the visit."""
    shard: int
    """Number of the shard in its set, from 0."""
    row: int
    """Row of the sample in the shard."""
    arrival: int
    """Position of the shard in the order of its epoch."""
    source: int = 0
    """Number of the dataset if several are mixed, from 0."""


@dataclass(frozen=True, kw_only=True)
class ShardWindow:
    """Shards that are open at the same time, and the shuffled order of their samples."""

    shards: tuple[int, ...]
    """Numbers of the shards, in the order of the epoch."""
    visits: tuple[Visit, ...]
    """Every sample of these shards exactly once, shuffled."""


@dataclass(frozen=True, kw_only=True)
class OrderSettings:
    """Settings that determine the order, besides the shards."""

    seed: int
    """Seed of the run's order."""
    window: int
    """Number of shards whose samples are shuffled together, at least 1."""


@dataclass(frozen=True, kw_only=True)
class RankSlice:
    """Slice of every global batch that one process takes."""

    rank: int = 0
    """Number of the process, from 0."""
    world_size: int = 1
    """Number of processes that train together."""

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.world_size:
            raise TrilightError(
                f"rank {self.rank} of {self.world_size}; expected a rank from 0 to "
                f"{self.world_size - 1}."
            )

    def require_equal(self, batch_size: int) -> None:
        """Raise TrilightError if a batch cannot be split equally over the ranks."""
        if batch_size % self.world_size:
            raise TrilightError(
                f"a batch of {batch_size} scenes is not divisible by {self.world_size} ranks; "
                "expected a multiple, so that each takes the same number."
            )

    def of_batch(self, visits: Sequence[Visit]) -> list[Visit]:
        """Return this process's slice of a global batch, in the order of positions."""
        size = len(visits) // self.world_size
        by_shard = sorted(visits, key=lambda visit: (visit.source, visit.arrival, visit.position))
        mine = by_shard[self.rank * size : (self.rank + 1) * size]
        return sorted(mine, key=lambda visit: visit.position)


def shuffled_shards(num_shards: int, settings: OrderSettings, epoch: int) -> list[int]:
    """Return the shard numbers in the order of an epoch."""
    rng = rng_for(settings.seed, "shards", epoch)
    return [int(shard) for shard in rng.permutation(num_shards)]


def windows_from(
    num_shards: int, num_samples: Callable[[int], int], settings: OrderSettings, first: int
) -> Iterator[ShardWindow]:
    """Yield endless windows, beginning with the one that holds position `first`.

    Args:
        num_samples: returns the size of a shard; called only for shards that are reached.

    Raises:
        TrilightError: all shards are empty.
    """
    total = sum(num_samples(shard) for shard in range(num_shards)) if first else 0
    epoch, start = (first // total, first // total * total) if total else (0, 0)
    while True:
        epoch_start = start
        order = shuffled_shards(num_shards, settings, epoch)
        for number, at in enumerate(range(0, num_shards, settings.window)):
            shards = order[at : at + settings.window]
            sizes = [num_samples(shard) for shard in shards]
            if any(sizes) and start + sum(sizes) > first:
                rng = rng_for(settings.seed, "samples", epoch, number)
                arrivals = [(a, row) for a, size in enumerate(sizes) for row in range(size)]
                visits = (
                    Visit(position=start + p, shard=shards[a], row=row, arrival=at + a)
                    for p, (a, row) in enumerate(arrivals[i] for i in rng.permutation(sum(sizes)))
                )
                yield ShardWindow(shards=tuple(shards), visits=tuple(visits))
            start += sum(sizes)
        if start == epoch_start:
            raise TrilightError(f"all {num_shards} shards are empty; expected a sample.")
        epoch += 1


def visits_from(windows: Iterator[ShardWindow], first: int) -> Iterator[Visit]:
    """Yield endless visits, from position `first` on."""
    return (visit for window in windows for visit in window.visits if visit.position >= first)


def batch_visits(visits: Iterator[Visit], batch_size: int) -> Iterator[tuple[Visit, ...]]:
    """Yield endless batches of visits."""
    while True:
        yield tuple(itertools.islice(visits, batch_size))
