"""Shards of one split, and their first scenes."""

import itertools
from collections.abc import Iterator

from storage.dataset import Dataset
from storage.errors import TrilightError
from storage.manifest import ShardEntry
from storage.sample import Sample


def shards_of(dataset: Dataset, split: str) -> list[ShardEntry]:
    """Return the shards of a split by name; raises TrilightError where it holds no scene."""
    shards = [shard for shard in dataset.shards_of(split) if shard.num_samples]
    if not shards:
        raise TrilightError(
            f"{dataset.folder.root}: the {split} split holds no scene; expected at least one. "
            "Generate the dataset with more scenes."
        )
    return shards


def first_samples(dataset: Dataset, split: str, limit: int) -> Iterator[Sample]:
    """Yield the first samples of a split, at most `limit`, in the order of the shards."""
    samples = (
        sample for shard in shards_of(dataset, split) for sample in dataset.read_shard(shard)
    )
    return itertools.islice(samples, limit)
