"""The order in which a run sees its scenes: a pure function of (seed, epoch, sizes of the shards).

Shards are permuted; then the samples of a window, a few shards in a row, are permuted among each
other. Epochs follow one another without a seam, and global batch i is the samples at positions
i B to (i + 1) B - 1 of that endless order, whatever the number of ranks and workers. Nothing has to
be stored to resume: the number of the batch says it all.

The ranks share out a batch by shard, so that each reads few shards of a window and not all.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from storage.errors import TrilightError
from storage.seeds import rng_for


@dataclass(frozen=True, kw_only=True, slots=True)
class Place:
    """One sample, at one point of the order."""

    position: int
    """Position in the endless order; it seeds the augmentation of the visit."""
    shard: int
    """Number of the shard."""
    row: int
    """Row of the sample in the shard."""
    arrival: int
    """Number of the shard in the order of its epoch."""
    source: int = 0
    """Number of the dataset, where several are mixed."""


@dataclass(frozen=True, kw_only=True)
class ShardWindow:
    """Shards that are open at the same time, and the order of their samples."""

    shards: tuple[int, ...]
    """Numbers of the shards, in the order of the epoch."""
    places: tuple[Place, ...]
    """Every sample of theirs exactly once."""


@dataclass(frozen=True, kw_only=True)
class OrderSettings:
    """What the order depends on, beside the shards."""

    seed: int
    """Seed of the run."""
    window: int
    """Shards among whose samples is shuffled, at least 1."""


@dataclass(frozen=True, kw_only=True)
class RankShare:
    """Which part of every global batch a process takes."""

    rank: int = 0
    """Number of the process, from 0."""
    world_size: int = 1
    """How many processes train together."""

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.world_size:
            raise TrilightError(
                f"rank {self.rank} of {self.world_size}; expected a rank from 0 to "
                f"{self.world_size - 1}."
            )

    def require_equal(self, batch_size: int) -> None:
        """Raise TrilightError where the ranks cannot all take the same number of samples."""
        if batch_size % self.world_size:
            raise TrilightError(
                f"a batch of {batch_size} scenes is not divisible by {self.world_size} ranks; "
                "expected a multiple, so that each takes the same number."
            )

    def of_batch(self, places: Sequence[Place]) -> list[Place]:
        """Return this process's part of a global batch, in the order of positions."""
        size = len(places) // self.world_size
        by_shard = sorted(places, key=lambda place: (place.source, place.arrival, place.position))
        mine = by_shard[self.rank * size : (self.rank + 1) * size]
        return sorted(mine, key=lambda place: place.position)


def shard_order(num_shards: int, settings: OrderSettings, epoch: int) -> list[int]:
    """Return the numbers of the shards in the order of an epoch."""
    rng = rng_for(settings.seed, "shards", epoch)
    return [int(shard) for shard in rng.permutation(num_shards)]


def windows_from(
    num_shards: int, num_samples: Callable[[int], int], settings: OrderSettings, first: int
) -> Iterator[ShardWindow]:
    """Yield windows without end, from the one that holds position `first` on.

    Args:
        num_shards: how many shards there are.
        num_samples: size of a shard by number; asked only for shards that have been reached.
        settings: seed and window.
        first: a position.

    Raises:
        TrilightError: all shards are empty.
    """
    total = sum(num_samples(shard) for shard in range(num_shards)) if first else 0
    epoch, start = (first // total, first // total * total) if total else (0, 0)
    while True:
        begun = start
        order = shard_order(num_shards, settings, epoch)
        for number, at in enumerate(range(0, num_shards, settings.window)):
            shards = order[at : at + settings.window]
            sizes = [num_samples(shard) for shard in shards]
            if any(sizes) and start + sum(sizes) > first:
                rng = rng_for(settings.seed, "samples", epoch, number)
                arrivals = [(a, row) for a, size in enumerate(sizes) for row in range(size)]
                places = (
                    Place(position=start + p, shard=shards[a], row=row, arrival=at + a)
                    for p, (a, row) in enumerate(arrivals[i] for i in rng.permutation(sum(sizes)))
                )
                yield ShardWindow(shards=tuple(shards), places=tuple(places))
            start += sum(sizes)
        if start == begun:
            raise TrilightError(f"all {num_shards} shards are empty; expected a sample.")
        epoch += 1


def places_from(windows: Iterator[ShardWindow], first: int) -> Iterator[Place]:
    """Yield places without end, from position `first` on."""
    return (place for window in windows for place in window.places if place.position >= first)


def batched(places: Iterator[Place], batch_size: int) -> Iterator[tuple[Place, ...]]:
    """Yield so many places at a time, without end."""
    while True:
        yield tuple(itertools.islice(places, batch_size))
