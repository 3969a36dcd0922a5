"""The order in which a run sees its scenes: a pure function of (seed, epoch).

Shards are read whole and one after another in a permuted order, as a disk or a bucket likes it; a
small window of samples is then shuffled. A sample therefore moves by about a window at most within
its epoch. Nothing has to be stored to resume: position p of the stream is known from p.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from storage.seeds import rng_for

Place = tuple[int, int]
"""(index of the shard, row in it)."""


@dataclass(frozen=True, kw_only=True)
class EpochOrder:
    """One pass over a split."""

    shards: tuple[int, ...]
    """In which order the shards are read."""
    places: tuple[Place, ...]
    """In which order their samples are used; each place exactly once."""


def epoch_order(num_samples: Sequence[int], *, seed: int, epoch: int, window: int) -> EpochOrder:
    """Return the order of one epoch over shards of the given sizes.

    Args:
        num_samples: samples of each shard.
        seed, epoch: what the order depends on.
        window: how many samples wait in memory to be drawn from, at least 1 (1 keeps the order).
    """
    rng = rng_for(seed, "order", epoch)
    shards = tuple(int(shard) for shard in rng.permutation(len(num_samples)))
    waiting: list[Place] = []
    places: list[Place] = []
    for arrival in ((shard, row) for shard in shards for row in range(num_samples[shard])):
        waiting.append(arrival)
        if len(waiting) == window:
            places.append(waiting.pop(int(rng.integers(len(waiting)))))
    while waiting:
        places.append(waiting.pop(int(rng.integers(len(waiting)))))
    return EpochOrder(shards=shards, places=tuple(places))
