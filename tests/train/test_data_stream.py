"""Laws of the stream: position p is one scene for ever, and errors arrive where they belong."""

import itertools
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from storage.dataset import Dataset
from storage.errors import TrilightError
from tests.train.toy import write_toy_dataset
from train.data.scenes import TrainingScene
from train.data.splits import first_samples, shards_of
from train.data.stream import StreamSettings, prefetched, stream_scenes

SETTINGS = StreamSettings(seed=1, window=3, resolution=16, views_per_scene=1)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=7, validation=2, per_shard=3)


def take(dataset: Dataset, first: int, count: int) -> list[TrainingScene]:
    stream = stream_scenes(dataset, shards_of(dataset, "train"), SETTINGS, first)
    return list(itertools.islice(stream, count))


def same(a: TrainingScene, b: TrainingScene) -> bool:
    return (
        a.key == b.key
        and torch.equal(a.target_VRR3, b.target_VRR3)
        and all(
            torch.equal(value, getattr(b.tensors, name)) for name, value in vars(a.tensors).items()
        )
    )


@pytest.mark.parametrize("first", [1, 6, 7, 9, 20])
def test_entering_later_gives_the_rest_of_the_same_stream(dataset: Dataset, first: int) -> None:
    whole, tail = take(dataset, 0, 24), take(dataset, first, 24 - first)
    assert all(same(a, b) for a, b in zip(whole[first:], tail, strict=True))


def test_epochs_show_every_scene_and_differ(dataset: Dataset) -> None:
    scenes = take(dataset, 0, 21)
    epochs = [scenes[start : start + 7] for start in (0, 7, 14)]
    keys = [[scene.key for scene in epoch] for epoch in epochs]
    assert all(len(set(epoch)) == 7 for epoch in keys)
    assert len({tuple(epoch) for epoch in keys}) > 1
    visits = [scene for scene in scenes if scene.key == keys[0][0]]
    assert not same(visits[0], visits[1]), "every visit draws its own views and symmetries"


def test_a_thread_ahead_changes_nothing_and_ends_when_closed(dataset: Dataset) -> None:
    before = threading.active_count()
    stream = stream_scenes(dataset, shards_of(dataset, "train"), SETTINGS, 4)
    ahead = prefetched(stream)
    got = list(itertools.islice(ahead, 12))
    assert all(same(a, b) for a, b in zip(got, take(dataset, 4, 12), strict=True))
    ahead.close()
    assert threading.active_count() == before


def test_a_damaged_shard_is_named_when_it_is_reached(tmp_path: Path) -> None:
    dataset = write_toy_dataset(tmp_path, train=6, validation=1, per_shard=2, resolution=8)
    shard = tmp_path / "train-000001.tar"
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    settings = StreamSettings(seed=0, window=1, resolution=8, views_per_scene=1)
    scenes = prefetched(stream_scenes(dataset, shards_of(dataset, "train"), settings, 0))
    with pytest.raises(TrilightError, match=r"train-000001.tar.*sha256"):
        for _ in range(6):
            next(scenes)


def test_a_bug_in_the_thread_is_not_swallowed() -> None:
    def broken() -> Iterator[TrainingScene]:
        raise RuntimeError("a bug")
        yield

    with pytest.raises(RuntimeError, match="a bug"):
        next(prefetched(broken()))


def test_first_samples_are_the_first(dataset: Dataset) -> None:
    keys = [sample.key for sample in first_samples(dataset, "train", 5)]
    assert keys == [f"{index:09d}" for index in range(5)]
    assert len(list(first_samples(dataset, "validation", 99))) == 2
    with pytest.raises(TrilightError, match="the test split holds no scene"):
        shards_of(dataset, "test")


def test_views_are_drawn_without_repetition(dataset: Dataset) -> None:
    settings = StreamSettings(seed=0, window=1, resolution=8, views_per_scene=2)
    shards = shards_of(dataset, "train")
    for scene in itertools.islice(stream_scenes(dataset, shards, settings, 0), 7):
        poses = scene.tensors.c2w_V44.numpy()
        assert poses.shape[0] == 2
        assert np.abs(poses[0] - poses[1]).max() > 0
