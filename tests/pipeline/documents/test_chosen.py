"""Which scenes are shown: as many as asked for, from every split, evenly."""

import itertools

import pytest

from pipeline.documents.chosen import choose_scenes
from storage.dataset.manifest import Manifest, MemberTable, ShardEntry


def manifest(**counts: int) -> Manifest:
    """Return a manifest with shards of four scenes, keys numbered through."""
    shards: list[ShardEntry] = []
    key = 0
    for split, count in counts.items():
        for first in range(0, count, 4):
            keys = range(key, key + min(4, count - first))
            key += len(keys)
            shards.append(
                ShardEntry(
                    name=f"{split}-{len(shards):06d}.tar",
                    split=split,
                    num_samples=len(keys),
                    num_bytes=0,
                    sha256="",
                    members=MemberTable(
                        (f"{k:09d}.{s}", 0, 0) for k in keys for s in ("json", "0.exr")
                    ),
                )
            )
    return Manifest(
        build="", settings={}, environment={}, num_scenes=key, num_views=1,
        objects_lock_sha256="", shards=tuple(shards),
    )  # fmt: skip


def test_all_where_there_are_few() -> None:
    chosen = choose_scenes(manifest(test=3, train=5), 48)
    assert [entry.split for entry in chosen] == ["train"] * 5 + ["test"] * 3
    assert [int(entry.key) for entry in chosen] == [3, 4, 5, 6, 7, 0, 1, 2]


def test_small_splits_are_seen() -> None:
    chosen = choose_scenes(manifest(train=4000, validation=20, test=3), 48)
    splits = [entry.split for entry in chosen]
    assert (splits.count("validation"), splits.count("test")) == (6, 3)
    assert len(set(entry.key for entry in chosen)) == len(chosen) == 48
    train = [int(entry.key) for entry in chosen if entry.split == "train"]
    gaps = [after - before for before, after in itertools.pairwise(train)]
    assert (train[0], train[-1]) == (0, 3999)
    assert max(gaps) - min(gaps) <= 1


@pytest.mark.parametrize("count", range(12))
def test_exactly_as_many_as_asked_for(count: int) -> None:
    keys = [entry.key for entry in choose_scenes(manifest(train=4, validation=4, test=4), count)]
    assert len(keys) == len(set(keys)) == count
