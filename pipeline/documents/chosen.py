"""Which scenes a person is shown: a few, spread evenly over splits and shards."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import Manifest, ShardEntry
from storage.records.sample import Sample

_LEAST_SHARE = 8
"""A split with few scenes gets up to one place in this many."""


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """One scene to show."""

    key: str
    shard: ShardEntry
    """The shard that holds the scene."""

    @property
    def split(self) -> str:
        return self.shard.split


def choose_scenes(manifest: Manifest, max_scenes: int) -> list[Chosen]:
    """Choose up to `max_scenes` scenes.

    Every split has its share of them, at least an eighth where it holds so many. Within a split
    they are spread evenly over its shards. The order is that of splits, then shards.
    """
    scenes = {
        split: [
            Chosen(key=key, shard=shard)
            for shard in manifest.shards
            if shard.split == split
            for key in shard.index
        ]
        for split in SPLITS
    }
    places = _places([len(scenes[split]) for split in SPLITS], max_scenes)
    chosen = []
    for split, count in zip(SPLITS, places, strict=True):
        rows = np.linspace(0, len(scenes[split]) - 1, count).round().astype(int)
        chosen += [scenes[split][row] for row in rows]
    return chosen


def read_chosen(dataset: Dataset, chosen: Sequence[Chosen]) -> Iterator[tuple[Chosen, Sample]]:
    """Yield the chosen scenes with their pictures, one at a time.

    Raises:
        TrilightError: a shard is missing, or a sample is unreadable or breaks a law.
    """
    for entry in chosen:
        for sample in dataset.read_samples(entry.shard, [entry.key]):
            yield entry, sample


def _places(counts: Sequence[int], max_scenes: int) -> list[int]:
    """Return how many scenes of each split to show, together at most `max_scenes`."""
    total = sum(counts)
    if total <= max_scenes:
        return list(counts)
    one_each = max_scenes >= sum(count > 0 for count in counts)
    wanted = max(max_scenes // _LEAST_SHARE, int(one_each))
    least = [min(count, wanted) for count in counts]
    left = max_scenes - sum(least)
    spare = [count - low for count, low in zip(counts, least, strict=True)]
    share = [left * entry // sum(spare) for entry in spare]
    while sum(share) < left:
        unmet = [entry - given for entry, given in zip(spare, share, strict=True)]
        share[int(np.argmax(unmet))] += 1
    return [low + more for low, more in zip(least, share, strict=True)]
