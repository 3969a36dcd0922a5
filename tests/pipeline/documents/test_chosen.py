"""Which scenes are shown: as many as asked for, from every split, evenly."""

import dataclasses
import itertools
from collections.abc import Mapping
from functools import cached_property
from typing import cast

from pipeline.documents.chosen import Chosen, choose_scenes
from storage.dataset.dataset import Dataset
from storage.dataset.manifest import ShardEntry


@dataclasses.dataclass
class Listed:
    """What is chosen from: shards of four scenes, keys numbered through; no file is there."""

    counts: Mapping[str, int]
    opened: list[str] = dataclasses.field(default_factory=list)

    def shards_of(self, split: str) -> list[ShardEntry]:
        return [shard for shard in self._keys if shard.split == split]

    def keys(self, shard: ShardEntry) -> list[str]:
        self.opened.append(shard.name)
        return self._keys[shard]

    @cached_property
    def _keys(self) -> dict[ShardEntry, list[str]]:
        keys: dict[ShardEntry, list[str]] = {}
        key = itertools.count()
        for split, count in self.counts.items():
            for first in range(0, count, 4):
                held = [f"{next(key):09d}" for _ in range(min(4, count - first))]
                shard = ShardEntry(
                    name=f"{split}-{len(keys):06d}.tar",
                    split=split,
                    num_samples=len(held),
                    num_bytes=0,
                    sha256="",
                )
                keys[shard] = held
        return keys


def chosen_of(max_scenes: int, **counts: int) -> list[Chosen]:
    return choose_scenes(cast(Dataset, Listed(counts)), max_scenes)


def test_all_where_there_are_few() -> None:
    chosen = chosen_of(48, test=3, train=5)
    assert [entry.split for entry in chosen] == ["train"] * 5 + ["test"] * 3
    assert [int(entry.key) for entry in chosen] == [3, 4, 5, 6, 7, 0, 1, 2]


def test_small_splits_are_seen() -> None:
    chosen = chosen_of(48, train=4000, validation=20, test=3)
    splits = [entry.split for entry in chosen]
    assert (splits.count("validation"), splits.count("test")) == (6, 3)
    assert len(set(entry.key for entry in chosen)) == len(chosen) == 48
    train = [int(entry.key) for entry in chosen if entry.split == "train"]
    gaps = [after - before for before, after in itertools.pairwise(train)]
    assert (train[0], train[-1]) == (0, 3999)
    assert max(gaps) - min(gaps) <= 1


def test_exactly_as_many_as_asked_for() -> None:
    for count in range(12):
        keys = [entry.key for entry in chosen_of(count, train=4, validation=4, test=4)]
        assert len(keys) == len(set(keys)) == count


def test_only_shards_of_chosen_scenes_are_opened() -> None:
    listed = Listed({"train": 4000, "test": 40})
    chosen = choose_scenes(cast(Dataset, listed), 10)
    assert sorted(listed.opened) == sorted({entry.shard.name for entry in chosen})
