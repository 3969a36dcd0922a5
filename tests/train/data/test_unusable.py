"""Damaged data: the first ends the run, or it is counted, replaced, and bounded."""

import dataclasses
import itertools
from contextlib import closing
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset
from storage.dataset.manifest import index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.order import RankShare
from train.data.stream import StreamSettings, stream_batches
from train.data.unusable import Unusable

SETTINGS = StreamSettings(seed=0, window=2, batch_size=4, resolution=8, views_per_scene=1)
BAD_KEY = "000000002"


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return write_toy_dataset(tmp_path, train=8, validation=1, per_shard=2, resolution=8)


def spoil_sample(dataset: Dataset, suffixes: tuple[str, ...] = ("0.exr", "1.exr")) -> None:
    """Make pictures of a sample unreadable whose shard has the hash of the manifest."""
    name = "train-000001.tar"
    samples = [
        (sample.key, encode_sample(sample))
        for sample in (toy_sample(i, resolution=8) for i in (2, 3))
    ]
    samples[0][1].update(dict.fromkeys(suffixes, b"no picture"))
    dataset.folder.shard(name).unlink()  # a shard is never written over
    write_shard(dataset.folder.shard(name), samples)
    shards = [
        index_shard(dataset.folder.shard(name)) if shard.name == name else shard
        for shard in dataset.manifest.shards
    ]
    write_manifest(
        dataset.folder.manifest, dataclasses.replace(dataset.manifest, shards=tuple(shards))
    )


def spoil_shard(dataset: Dataset) -> None:
    path = dataset.folder.shard("train-000001.tar")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def keys(
    data: TrainingData, unusable: Unusable, *, rank: int = 0, world_size: int = 1, count: int = 4
) -> list[list[str]]:
    batches = stream_batches(
        data.split("train"),
        SETTINGS,
        0,
        share=RankShare(rank=rank, world_size=world_size),
        workers=2,
        unusable=unusable,
    )
    with closing(batches):
        return [[scene.key for scene in batch] for batch in itertools.islice(batches, count)]


def opened(dataset: Dataset) -> TrainingData:
    return open_training_data([str(dataset.folder.root)])


def test_the_first_damage_ends_the_run_and_is_named(dataset: Dataset) -> None:
    spoil_sample(dataset)
    with pytest.raises(TrilightError, match=rf"train-000001\.tar: sample {BAD_KEY}: .*OpenEXR"):
        keys(opened(dataset), Unusable(0))


def test_a_sample_is_replaced_by_the_next_of_its_shard(dataset: Dataset) -> None:
    whole = keys(opened(dataset), Unusable(0))
    spoil_sample(dataset)
    unusable = Unusable(1)
    found = keys(opened(dataset), unusable)
    assert found == [[key.replace(BAD_KEY, "000000003") for key in batch] for batch in whole]
    assert len(unusable.messages) == 1 and BAD_KEY in unusable.messages[0]


def test_damage_costs_only_the_visits_that_draw_its_view(dataset: Dataset) -> None:
    whole = keys(opened(dataset), Unusable(0))
    visits = [(batch, row) for batch in range(4) for row in range(4)]
    replaced = list[set[tuple[int, int]]]()
    for suffix in ("0.exr", "1.exr"):
        spoil_sample(dataset, (suffix,))
        found = keys(opened(dataset), Unusable(1))
        replaced.append({at for at in visits if found[at[0]][at[1]] != whole[at[0]][at[1]]})
    drawn = {at for at in visits if whole[at[0]][at[1]] == BAD_KEY}
    assert replaced[0] | replaced[1] == drawn and not replaced[0] & replaced[1]


def test_a_shard_is_replaced_and_counts_with_its_samples(dataset: Dataset) -> None:
    whole = keys(opened(dataset), Unusable(0))
    spoil_shard(dataset)
    unusable = Unusable(2)
    found = keys(opened(dataset), unusable)
    assert [len(batch) for batch in found] == [4, 4, 4, 4]
    kept = [k for batch in whole for k in batch]
    for before, after in zip(kept, itertools.chain(*found), strict=True):
        lost = before in ("000000002", "000000003")
        assert after not in ("000000002", "000000003")
        assert lost or after == before
    assert "train-000001.tar" in unusable.messages[0] and "sha256" in unusable.messages[0]
    with pytest.raises(TrilightError, match="2 samples are unusable; expected at most 1"):
        keys(opened(dataset), Unusable(1))


def test_what_replaces_does_not_depend_on_the_ranks(dataset: Dataset) -> None:
    spoil_sample(dataset)
    whole = keys(opened(dataset), Unusable(1))
    shares = [keys(opened(dataset), Unusable(1), rank=r, world_size=2) for r in range(2)]
    for batch, first, second in zip(whole, *shares, strict=True):
        assert sorted(batch) == sorted([*first, *second])


def test_a_list_with_an_unreadable_shard_goes_on_without_it(dataset: Dataset) -> None:
    (dataset.folder.root / "train-000001.tar").write_bytes(b"no shard at all")
    data = open_training_data([f"{dataset.folder.root}/train-{{000000..000003}}.tar"])
    unusable = Unusable(1)
    found = keys(data, unusable, count=3)
    assert {key for batch in found for key in batch} == {
        f"00000000{index}" for index in (0, 1, 4, 5, 6, 7)
    }
    assert len(unusable.messages) == 1


def test_all_unusable_ends_the_run(dataset: Dataset) -> None:
    for path in dataset.folder.root.glob("train-*.tar"):
        path.write_bytes(b"no shard at all")
    with pytest.raises(
        TrilightError, match="no sample of 4 shards is usable. The last that was tried: "
    ):
        keys(opened(dataset), Unusable(10**9))
