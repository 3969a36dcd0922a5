"""Shards are opened when their first sample is planned, and closed after their last is read."""

from collections.abc import Sequence

import pytest

from storage.dataset.shard_set import OpenShard, ShardSet
from storage.errors import TrilightError
from train.data.open_shards import OpenShards


class _Shard(OpenShard):
    def __init__(self, name: str, closed: list[str]) -> None:
        self.name = name
        self.closed = closed

    def close(self) -> None:
        self.closed.append(self.name)


class _Shards(ShardSet):
    names: Sequence[str] = ("a", "b", "c", "broken")

    def __init__(self) -> None:
        self.opened: list[str] = []
        self.closed: list[str] = []

    def num_samples(self, number: int) -> int:
        return 1

    def open(self, number: int) -> OpenShard:
        if number == 3:
            raise TrilightError("broken: is broken")
        self.opened.append(self.names[number])
        return _Shard(self.names[number], self.closed)


def test_each_is_open_from_its_first_sample_to_its_last() -> None:
    shards = _Shards()
    with OpenShards(shards) as opened:
        opened.plan([0, 0, 1])
        opened.plan([1, 2])
        assert [opened.read(number).name for number in (0, 1, 2)] == ["a", "b", "c"]
        opened.done([0, 0, 1])
        assert shards.closed == ["a"]
        assert opened.read(1).name == "b"
        opened.done([1])
        assert shards.closed == ["a", "b"]
        opened.plan([0])
        assert opened.read(0).name == "a"
        assert sorted(shards.opened) == ["a", "a", "b", "c"]
    assert sorted(shards.closed) == ["a", "a", "b", "c"]


def test_an_error_comes_to_whoever_reads() -> None:
    with OpenShards(_Shards()) as opened:
        opened.plan([3, 0])
        assert opened.read(0).name == "a"
        with pytest.raises(TrilightError, match="is broken"):
            opened.read(3)
        opened.done([3])
