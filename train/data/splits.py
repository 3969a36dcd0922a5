"""The first scenes of a split."""

from collections.abc import Iterator
from contextlib import closing

from storage.dataset.shard_set import ShardSet
from storage.errors import TrilightError
from storage.records.sample import Sample
from train.data.unusable import Unusable


def first_samples(shards: ShardSet, limit: int, unusable: Unusable) -> Iterator[Sample]:
    """Yield the first usable samples of a split, at most `limit`, in the order of the shards.

    Raises:
        TrilightError: more is unusable than may be.
    """
    left = limit
    for number, name in enumerate(shards.names):
        if not left:
            return
        try:
            shard = shards.open(number)
        except TrilightError as error:
            unusable.add(name, lost_with(shards, number), error)
            continue
        with closing(shard):
            for row, key in enumerate(shard.keys[:left]):
                try:
                    sample = shard.sample(row)
                except TrilightError as error:
                    unusable.add(f"{shard.name}: sample {key}", 1, error)
                    continue
                yield sample
                left -= 1


def lost_with(shards: ShardSet, number: int) -> int:
    """Return how many samples are lost with a shard; 1 where nothing tells."""
    try:
        return shards.num_samples(number)
    except TrilightError:
        return 1
