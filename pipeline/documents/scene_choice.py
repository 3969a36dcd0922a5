"""Chooses a few scenes to show, spread evenly over splits and shards."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import ShardEntry
from storage.records.sample import Sample

_LEAST_SHARE = 8
"""Divisor of the chosen scenes: a split with few scenes gets up to one in this many."""


@dataclass(frozen=True, kw_only=True)
class ChosenScene:
    """One scene to show."""

    key: str
    shard: ShardEntry
    """The shard that holds the scene."""

    @property
    def split(self) -> str:
        return self.shard.split


def choose_scenes(
    dataset: Dataset, max_scenes: int, splits: Sequence[str] = SPLITS
) -> list[ChosenScene]:
    """Choose up to `max_scenes` scenes; only shards with chosen scenes are opened.

    Every split gets scenes in proportion, at least an eighth if it has so many. Within a split they
    are spread evenly over its shards. The order is that of splits, then shards.

    Raises:
        TrilightError: a shard is missing or damaged.
    """
    shards = [dataset.shards_of(split) for split in splits]
    ends = [np.cumsum([shard.num_samples for shard in each], dtype=int) for each in shards]
    counts = [int(each[-1]) if len(each) else 0 for each in ends]
    chosen = []
    for each, end, count, num_chosen in zip(
        shards, ends, counts, _scenes_per_split(counts, max_scenes), strict=True
    ):
        rows = np.linspace(0, count - 1, num_chosen).round().astype(int)
        holding = np.searchsorted(end, rows, side="right")
        for number in dict.fromkeys(holding.tolist()):
            shard = each[number]
            keys = dataset.keys(shard)
            first = int(end[number]) - shard.num_samples
            inside = rows[holding == number] - first
            chosen += [ChosenScene(key=keys[row], shard=shard) for row in inside]
    return chosen


def read_chosen(
    dataset: Dataset, chosen: Sequence[ChosenScene]
) -> Iterator[tuple[ChosenScene, Sample]]:
    """Yield the chosen scenes with their pictures, one at a time.

    Raises:
        TrilightError: a shard is missing, or a sample is unreadable or breaks a law.
    """
    for entry in chosen:
        for sample in dataset.read_samples(entry.shard, [entry.key]):
            yield entry, sample


def _scenes_per_split(counts: Sequence[int], max_scenes: int) -> list[int]:
    """Return the number of scenes to show of each split, together at most `max_scenes`."""
    total = sum(counts)
    if total <= max_scenes:
        return list(counts)
    one_each = max_scenes >= sum(count > 0 for count in counts)
    minimum = max(max_scenes // _LEAST_SHARE, int(one_each))
    least = [min(count, minimum) for count in counts]
    remaining = max_scenes - sum(least)
    spare = [count - low for count, low in zip(counts, least, strict=True)]
    share = [remaining * entry // sum(spare) for entry in spare]
    while sum(share) < remaining:
        unmet = [entry - granted for entry, granted in zip(spare, share, strict=True)]
        share[int(np.argmax(unmet))] += 1
    return [low + more for low, more in zip(least, share, strict=True)]
