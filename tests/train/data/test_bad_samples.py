"""Damaged or malformed data: the first ends the run, or it is named, replaced and bounded."""

import itertools
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from safetensors.numpy import load, save

from storage.dataset.dataset import Dataset
from storage.dataset.shard import ShardReader, write_shard
from storage.dataset.shard_set import ShardSet
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from tests.storage.dataset.test_verify import replace_shard
from tests.train.kit import flip_a_bit, keys_of, plain_run, take
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.bad_samples import BadSampleCounter

SETTINGS = plain_run(seed=0, shuffle_shards=2, scenes_per_step=4, resolution=8, views_per_scene=1)
BAD_KEY = "000000002"


def keys(
    data: TrainingData | Dataset, unusable: BadSampleCounter, *, count: int = 4, **ranks: int
) -> list[list[str]]:
    part: dict[str, Any] = ranks
    return keys_of(take(data, SETTINGS, count, workers=2, unusable=unusable, **part))


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return write_toy_dataset(tmp_path, train=8, validation=1, per_shard=2, resolution=8)


def spoil_sample(dataset: Dataset, suffixes: tuple[str, ...] = ("0.exr", "1.exr")) -> None:
    """Make pictures of a sample unreadable whose shard has the hash of the manifest."""
    samples = [
        (sample.key, encode_sample(sample))
        for sample in (toy_sample(i, resolution=8) for i in (2, 3))
    ]
    samples[0][1].update(dict.fromkeys(suffixes, b"no picture"))
    replace_shard(dataset, "train-000001.tar", samples)


def test_the_first_damage_ends_the_run_or_is_replaced_whatever_the_ranks(dataset: Dataset) -> None:
    spoil_sample(dataset)
    with pytest.raises(TrilightError, match=rf"train-000001\.tar: sample {BAD_KEY}: .*OpenEXR"):
        keys(dataset, BadSampleCounter(0))
    spoil_sample(dataset)
    whole = keys(dataset, BadSampleCounter(1))
    shares = [keys(dataset, BadSampleCounter(1), rank=r, world_size=2) for r in range(2)]
    for batch, first, second in zip(whole, *shares, strict=True):
        assert sorted(batch) == sorted([*first, *second])


def test_a_sample_is_replaced_by_the_next_of_its_shard(dataset: Dataset) -> None:
    whole = keys(dataset, BadSampleCounter(0))
    spoil_sample(dataset)
    unusable = BadSampleCounter(1)
    found = keys(dataset, unusable)
    assert found == [[key.replace(BAD_KEY, "000000003") for key in batch] for batch in whole]
    assert len(unusable.messages) == 1 and BAD_KEY in unusable.messages[0]


def test_damage_costs_only_the_visits_that_draw_its_view(dataset: Dataset) -> None:
    whole = keys(dataset, BadSampleCounter(0))
    visits = [(batch, row) for batch in range(4) for row in range(4)]
    replaced = list[set[tuple[int, int]]]()
    for suffix in ("0.exr", "1.exr"):
        spoil_sample(dataset, (suffix,))
        found = keys(dataset, BadSampleCounter(1))
        replaced.append({at for at in visits if found[at[0]][at[1]] != whole[at[0]][at[1]]})
    drawn = {at for at in visits if whole[at[0]][at[1]] == BAD_KEY}
    assert replaced[0] | replaced[1] == drawn and not replaced[0] & replaced[1]


def test_a_shard_is_replaced_and_counts_with_its_samples(dataset: Dataset) -> None:
    whole = keys(dataset, BadSampleCounter(0))
    flip_a_bit(dataset.folder.shard("train-000001.tar"))
    unusable = BadSampleCounter(2)
    found = keys(dataset, unusable)
    assert [len(batch) for batch in found] == [4, 4, 4, 4]
    kept = [k for batch in whole for k in batch]
    for before, after in zip(kept, itertools.chain(*found), strict=True):
        lost = before in ("000000002", "000000003")
        assert after not in ("000000002", "000000003")
        assert lost or after == before
    assert "train-000001.tar" in unusable.messages[0] and "sha256" in unusable.messages[0]
    with pytest.raises(TrilightError, match="2 samples are unusable; expected at most 1"):
        keys(dataset, BadSampleCounter(1))


def test_a_list_with_an_unreadable_shard_goes_on_without_it(dataset: Dataset) -> None:
    (dataset.folder.root / "train-000001.tar").write_bytes(b"no shard at all")
    data = open_training_data([f"{dataset.folder.root}/train-{{000000..000003}}.tar"])
    unusable = BadSampleCounter(1)
    found = keys(data, unusable, count=3)
    assert {key for batch in found for key in batch} == {
        f"00000000{index}" for index in (0, 1, 4, 5, 6, 7)
    }
    assert len(unusable.messages) == 1


def test_a_shard_that_ends_the_run_was_fetched_once(dataset: Dataset) -> None:
    for path in dataset.folder.root.glob("train-*.tar"):
        path.write_bytes(b"no shard at all")
    data = open_training_data([f"{dataset.folder.root}/train-000000.tar"])
    fetch = mock.patch.object(ShardSet, "open", autospec=True, side_effect=ShardSet.open)
    with fetch as fetched, pytest.raises(TrilightError, match="train-000000"):
        keys(data, BadSampleCounter(0))
    assert fetched.call_count == 1


def test_all_unusable_ends_the_run(dataset: Dataset) -> None:
    for path in dataset.folder.root.glob("train-*.tar"):
        path.write_bytes(b"no shard at all")
    with pytest.raises(
        TrilightError, match="no sample of 4 shards is usable. The last that was tried: "
    ):
        keys(dataset, BadSampleCounter(10**9))


BOTH_VIEWS = plain_run(seed=0, shuffle_shards=2, scenes_per_step=2, resolution=8, views_per_scene=2)
BAD, GOOD = "bad-000000.tar", "good-000000.tar"
Members = dict[str, bytes]


def lose_a_place(members: Members) -> None:
    """Put what is no number into the positions of a sample."""
    arrays = {key: values.copy() for key, values in load(members["scene.safetensors"]).items()}
    arrays["vertex_positions"][0, 1] = np.nan
    members["scene.safetensors"] = save(arrays)


def write_shards(folder: Path, bad_samples: int) -> list[str]:
    """Write a shard whose first samples are spoilt and one without fault; return their paths."""
    for name, first, count in ((BAD, 0, 3), (GOOD, 3, 2)):
        samples = []
        for index in range(first, first + count):
            sample = toy_sample(index, resolution=8, views=2)
            members = encode_sample(sample)
            if index < bad_samples:
                lose_a_place(members)
            samples.append((sample.key, members))
        write_shard(folder / name, samples)
    return [f"{folder}/{BAD}", f"{folder}/{GOOD}"]


def spoilt_keys(paths: list[str], unusable: BadSampleCounter, count: int = 5) -> set[str]:
    found = take(open_training_data(paths), BOTH_VIEWS, count, unusable=unusable)
    return set(itertools.chain(*keys_of(found)))


def test_a_shard_that_is_all_bad_is_given_up_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = write_shards(tmp_path, bad_samples=3)
    decode = ShardReader.stored_sample
    read: Any = mock.create_autospec(decode, side_effect=decode)
    monkeypatch.setattr(ShardReader, "stored_sample", read)
    unusable = BadSampleCounter(3)
    found = spoilt_keys(paths, unusable, count=10)
    assert found == {"000000003", "000000004"}
    assert len(unusable.messages) == 3
    for row, message in enumerate(unusable.messages):
        assert message.isprintable() and f"/{BAD}: sample 00000000{row}: " in message
        assert "vertex_positions[0, 1] is nan" in message
    bad = [each.args[1] for each in read.call_args_list if BAD in each.args[0].name]
    assert len(bad) == len(set(bad)) == 3


def test_a_scene_with_fewer_views_than_are_drawn_is_replaced(tmp_path: Path) -> None:
    paths = write_shards(tmp_path, bad_samples=0)
    (tmp_path / GOOD).unlink()
    few = toy_sample(3, resolution=8, views=1)
    write_shard(tmp_path / GOOD, [(few.key, encode_sample(few))])
    unusable = BadSampleCounter(1)
    assert few.key not in spoilt_keys(paths, unusable)
    assert "1 views; the run draws 2 of each scene" in unusable.messages[0]
