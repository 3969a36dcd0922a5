"""Sample of a huge dataset's shards: evenly spaced ones of each split."""

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import ShardEntry

MOST_SCENES = 20_000
"""Scenes that are read to describe a dataset: of a percentile over as many, chance moves less than
half a point (binomial, 95 %), and they take minutes."""


def described_shards(dataset: Dataset, most_scenes: int | None = None) -> list[ShardEntry]:
    """Return the shards by which a dataset is described, in its order.

    They are all where those hold no more than `most_scenes` (MOST_SCENES); else every n-th of each
    split, its first one among them.
    """
    most_scenes = MOST_SCENES if most_scenes is None else most_scenes
    every = -(-dataset.manifest.num_samples // most_scenes)
    if every <= 1:
        return list(dataset.manifest.shards)
    chosen = {shard.name for split in SPLITS for shard in dataset.shards_of(split)[::every]}
    return [shard for shard in dataset.manifest.shards if shard.name in chosen]


def of_how_many(num_read: int, num_scenes: int) -> str:
    """Return the remark that a sample of the scenes stands for all; else an empty text."""
    return "" if num_read >= num_scenes else f"of a sample of {num_read} of {num_scenes} scenes"
