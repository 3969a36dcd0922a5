"""The smallest and largest things that a training run may be made to read, or is refused."""

import itertools
from pathlib import Path

import pytest

from infra.bench.subjects.manifests import SAMPLES_PER_SHARD, write_manifest_of
from pipeline.making.derive_dataset import derive_dataset
from pipeline.shards.derive import Derive, derive_shards
from pipeline.shards.finished import open_finished
from pipeline.shards.plans import Selection
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import read_manifest, write_manifest
from storage.dataset.training_data import open_training_data
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from tests.pipeline.making.derive_kit import finished, scenes
from tests.train.kit import keys_of, take
from tests.train.toy import write_toy_dataset
from train.data.order import OrderSettings, batches_from, windows_from
from train.data.stream import StreamSettings


def keys(
    root: Path, batch_size: int, count: int, *, first: int = 0, window: int = 4, ranks: int = 1
) -> list[list[str]]:
    """Return the keys of the batches first, first + 1, ... of a dataset, sorted."""
    settings = StreamSettings(
        seed=0, window=window, batch_size=batch_size, resolution=8, views_per_scene=1
    )
    data = open_training_data([str(root)])
    shares = [take(data, settings, count, first=first, rank=rank, world_size=ranks)
              for rank in range(ranks)]  # fmt: skip
    return [sorted(itertools.chain(*keys_of(parts))) for parts in zip(*shares, strict=True)]


def every(train: int) -> list[str]:
    return [f"{index:09d}" for index in range(train)]


@pytest.mark.parametrize(
    ("train", "per_shard", "views"),
    [(1, 1, 1), (5, 1, 1), (5, 99, 2)],
    ids=["one sample of one view", "one sample a shard", "one shard"],
)
def test_small_splits_are_shown_whole_in_every_epoch(
    tmp_path: Path, train: int, per_shard: int, views: int
) -> None:
    write_toy_dataset(
        tmp_path, train=train, validation=1, per_shard=per_shard, resolution=8, views=views
    )
    for window in (1, 1000):
        assert keys(tmp_path, train, 3, window=window) == [every(train)] * 3, window


def test_a_batch_may_be_larger_than_the_split(tmp_path: Path) -> None:
    """It then holds scenes of several epochs, each as often as there are epochs, one more or less;
    and a rank for every scene of it changes nothing."""
    write_toy_dataset(tmp_path, train=3, validation=1, per_shard=2, resolution=8)
    (batch, other) = keys(tmp_path, 8, 2)
    assert len(batch) == len(other) == 8
    counts = [(batch + other).count(key) for key in every(3)]
    assert sorted(counts) == [5, 5, 6]
    assert keys(tmp_path, 8, 2, ranks=8) == [batch, other]


def test_a_batch_in_a_distant_epoch_is_had_at_once(tmp_path: Path) -> None:
    write_toy_dataset(tmp_path, train=5, validation=1, per_shard=2, resolution=8)
    first = 10**12
    assert keys(tmp_path, 5, 2, first=first) == [every(5)] * 2  # 5 x 10^12 begins an epoch
    order = OrderSettings(seed=2**63, window=2)
    windows = windows_from(3, lambda shard: 7, order, 3 * first)
    batch = next(batches_from(windows, 3 * first, 64))
    assert [place.position for place in batch] == list(range(3 * first, 3 * first + 64))


@pytest.mark.parametrize("num_samples", [0, 1, SAMPLES_PER_SHARD + 1, 20_000])
def test_an_index_of_any_length_comes_back(tmp_path: Path, num_samples: int) -> None:
    write_manifest_of(tmp_path, num_samples)
    path = DatasetFolder(tmp_path).manifest
    manifest, text = read_manifest(path), path.read_bytes()
    assert manifest.num_samples == num_samples
    write_manifest(path, manifest)
    assert path.read_bytes() == text
    data = open_training_data([str(tmp_path)])
    assert len(data.splits) == min(num_samples, 1)
    if not num_samples:
        with pytest.raises(TrilightError, match="the train split holds no scene"):
            data.split("train")


def test_a_selection_of_one_scene_is_a_dataset_and_of_none_is_refused(tmp_path: Path) -> None:
    source = finished(tmp_path / "a", scenes(0))  # the best floor is 41 dB, of scene 5
    one = Derive(operation="select", selection=Selection(min_noise_floor_db=40.9))
    derive_shards([open_finished(str(source))], one, DatasetFolder(tmp_path / "one"))
    assert verify_dataset(tmp_path / "one").problems == []
    (shard,) = open_dataset(str(tmp_path / "one")).manifest.shards
    assert (shard.split, shard.num_samples) == ("test", 1)
    none = Derive(operation="select", selection=Selection(min_noise_floor_db=41.1))
    with pytest.raises(TrilightError, match="none of the 6 scenes"):
        derive_dataset([str(source)], none, tmp_path / "none")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "one"]
