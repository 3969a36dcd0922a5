"""Laws of the order: each sample once an epoch, the same batches for any number of ranks.

And of the shards that are open for it, whose memory does not grow with the dataset.
"""

import dataclasses
import itertools
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.dataset.shard import write_shard
from storage.dataset.shard_set import OpenShard, ShardSet
from storage.errors import TrilightError
from storage.records.sample import Sample, encode_sample, sample_key
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.train.toy import toy_sample
from train.data.open_shards import OpenShards
from train.data.order import (
    OrderSettings,
    RankSlice,
    ShardWindow,
    Visit,
    batch_visits,
    visits_from,
    windows_from,
)

SIZES = st.lists(st.integers(0, 9), min_size=1, max_size=9).filter(any)
WORLDS = (1, 2, 3, 8)
BATCH = 24


def windows(
    sizes: list[int], first: int = 0, *, seed: int = 0, window: int = 2
) -> list[ShardWindow]:
    """Return the windows of two epochs from the one that holds `first`."""
    chosen = OrderSettings(seed=seed, window=window)
    stream = windows_from(len(sizes), lambda shard: sizes[shard], chosen, first)
    end = 2 * sum(sizes)
    return list(itertools.takewhile(lambda one: one.visits[0].position < end, stream))


def places(found: list[ShardWindow]) -> list[Visit]:
    return [place for window in found for place in window.visits]


@settings(deadline=None)  # a busy machine is no failure
@given(SIZES, st.integers(1, 12), st.integers(0, 3))
def test_an_epoch_uses_every_sample_once_and_positions_count(
    sizes: list[int], window: int, seed: int
) -> None:
    found = places(windows(sizes, seed=seed, window=window))
    every = {(shard, row) for shard, size in enumerate(sizes) for row in range(size)}
    total = len(every)
    assert [place.position for place in found] == list(range(2 * total))
    for epoch in (found[:total], found[total:]):
        assert {(place.shard, place.row) for place in epoch} == every


@settings(deadline=None)  # a busy machine is no failure
@given(SIZES, st.integers(1, 12))
def test_samples_stay_within_their_window_of_shards(sizes: list[int], window: int) -> None:
    for one in windows(sizes, window=window):
        assert len(one.shards) <= window
        held = {(shard, row) for shard in one.shards for row in range(sizes[shard])}
        assert {(place.shard, place.row) for place in one.visits} == held


@settings(deadline=None)  # a busy machine is no failure
@given(SIZES, st.data())
def test_entering_later_gives_the_rest(sizes: list[int], data: st.DataObject) -> None:
    first = data.draw(st.integers(0, 2 * sum(sizes) - 1))
    whole = places(windows(sizes))
    assert first in [place.position for place in windows(sizes, first)[0].visits]
    assert [p for p in places(windows(sizes, first)) if p.position >= first] == whole[first:]


def test_the_order_is_a_function_of_seed_and_epoch() -> None:
    sizes = [16, 16, 16]
    assert windows(sizes, seed=3) == windows(sizes, seed=3)
    both = [places(windows(sizes, seed=seed, window=3)) for seed in range(3)]
    epochs = [epoch for found in both for epoch in (found[:48], found[48:])]
    assert len({tuple((p.shard, p.row) for p in epoch) for epoch in epochs}) == 6
    assert len({tuple(p.shard for p in epoch) for epoch in epochs}) == 6


@settings(deadline=None)  # a busy machine is no failure
@given(SIZES, st.integers(0, 40), st.integers(1, 5))
def test_the_ranks_share_out_every_batch(sizes: list[int], first: int, window: int) -> None:
    """Whatever their number: each place with one rank, equally many each, nobody left out."""
    chosen = OrderSettings(seed=1, window=window)
    stream = windows_from(len(sizes), lambda shard: sizes[shard], chosen, first)
    for batch in itertools.islice(batch_visits(visits_from(stream, first), BATCH), 3):
        assert [place.position for place in batch] == list(range(first, first + BATCH))
        first += BATCH
        for world in WORLDS:
            shares = [RankSlice(rank=r, world_size=world).of_batch(batch) for r in range(world)]
            assert {len(share) for share in shares} == {BATCH // world}
            assert sorted(itertools.chain(*shares), key=lambda p: p.position) == list(batch)


def test_each_rank_reads_few_shards_of_a_window() -> None:
    """That is why batches are shared out by shard: 2 ranks of 8 shards need about 4 each."""
    sizes = [64] * 8
    chosen = OrderSettings(seed=0, window=8)
    stream = windows_from(8, lambda shard: sizes[shard], chosen, 0)
    read: list[set[int]] = [set(), set()]
    samples: list[list[int]] = [[], []]
    for batch in itertools.islice(batch_visits(visits_from(stream, 0), 64), 8):
        for rank in range(2):
            mine = RankSlice(rank=rank, world_size=2).of_batch(batch)
            read[rank] |= {place.shard for place in mine}
            samples[rank] += [place.arrival for place in mine]
    # measured: 5 and 5 of 8; a share drawn without regard to shards needs all 8
    assert max(len(shards) for shards in read) <= 6
    assert max(samples[0]) < 6 and min(samples[1]) > 1


@for_each(("rank", "world_size"), [(1, 1), (-1, 2), (0, 0)])
def test_ranks_that_do_not_exist_are_refused(rank: int, world_size: int) -> None:
    with pytest.raises(TrilightError, match="expected a rank from 0"):
        RankSlice(rank=rank, world_size=world_size)


def test_unequal_shares_and_empty_shards_are_refused() -> None:
    with pytest.raises(TrilightError, match="batch of 10 scenes is not divisible by 4 ranks"):
        RankSlice(rank=0, world_size=4).require_equal(10)
    chosen = OrderSettings(seed=0, window=1)
    with pytest.raises(TrilightError, match="all 3 shards are empty"):
        next(windows_from(3, lambda shard: 0, chosen, 0))


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


def test_shards_are_open_from_their_first_sample_to_their_last_and_errors_come_to_who_reads() -> (
    None
):
    shards = _Shards()
    with OpenShards(shards) as opened:
        opened.plan([0, 0, 1])
        opened.plan([1, 2])
        assert [opened.read(number).name for number in (0, 1, 2)] == ["a", "b", "c"]
        opened.mark_read([0, 0, 1])
        assert shards.closed == ["a"]
        assert opened.read(1).name == "b"
        opened.mark_read([1])
        assert shards.closed == ["a", "b"]
        opened.plan([0])
        assert opened.read(0).name == "a"
        assert sorted(shards.opened) == ["a", "a", "b", "c"]
    assert sorted(shards.closed) == ["a", "a", "b", "c"]
    with OpenShards(_Shards()) as opened:
        opened.plan([3, 0])
        assert opened.read(0).name == "a"
        with pytest.raises(TrilightError, match="is broken"):
            opened.read(3)
        opened.mark_read([3])


SHARDS, PER_SHARD, RESOLUTION = 30, 8, 128

CHILD = """
import itertools, json, resource, sys
from contextlib import closing
from storage.dataset.training_data import open_training_data
from train.data.order import RankSlice
from train.data.stream import StreamSettings, stream_batches
from train.data.bad_samples import BadSampleCounter
settings = StreamSettings(seed=0, window=2, batch_size=8, resolution=16, views_per_scene=2)
data = open_training_data([sys.argv[1]]).split("train")
batches = stream_batches(
    data, settings, 0, rank_slice=RankSlice(), workers=2, unusable=BadSampleCounter(0)
)
count = peak = 0
with closing(batches):
    for batch in itertools.islice(batches, int(sys.argv[2])):
        count += len(batch)
        pages = int(open("/proc/self/statm").read().split()[1])
        peak = max(peak, pages * resource.getpagesize())
print(json.dumps([count, peak]))
"""


def noisy(index: int) -> Sample:
    """A sample whose pictures cannot be packed into less."""
    rng = np.random.default_rng(index)
    picture = rng.random((2, RESOLUTION, RESOLUTION, 3)).astype(np.float32)
    return dataclasses.replace(
        toy_sample(0, resolution=8), key=sample_key(index), radiance_rgb=picture
    )


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("large")
    for number in range(SHARDS):
        samples = [noisy(PER_SHARD * number + row) for row in range(PER_SHARD)]
        write_shard(
            folder / f"train-{number:06d}.tar", [(s.key, encode_sample(s)) for s in samples]
        )
    return folder


def peak_bytes(folder: Path, num_shards: int) -> int:
    """Return the most memory of a process that reads so many shards once."""
    pattern = f"{folder}/train-{{000000..{num_shards - 1:06d}}}.tar"
    command = [sys.executable, "-c", CHILD, pattern, str(num_shards * PER_SHARD // 8)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    count, peak = json.loads(ran.stdout)
    assert count == num_shards * PER_SHARD
    return int(peak)


@pytest.mark.slow("memory")
def test_the_reader_holds_as_much_of_a_large_set_as_of_a_small_one(shards: Path) -> None:
    """6 shards of 1.4 MB and 30: what is read grows by 33 MB, more when it is unpacked."""
    more = sum(path.stat().st_size for path in shards.iterdir()) * (SHARDS - 6) // SHARDS
    grown = peak_bytes(shards, SHARDS) - peak_bytes(shards, 6)
    # a tenth of what was read leaves room for what the allocator keeps; measured: 0.5 MB
    assert grown < more / 10
