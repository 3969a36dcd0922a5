"""Reading through the headers of shards: the same scenes as the whole shard, and nothing else."""

import json
from pathlib import Path

import numpy as np
import pytest

from storage.dataset.dataset import open_dataset
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from tests.for_each import for_each
from tests.pipeline.documents.dataset_by_hand import edit_manifest, five_scenes


def test_scenes_are_those_of_the_samples(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    for shard in dataset.manifest.shards:
        samples = list(dataset.read_shard(shard))
        scenes = list(dataset.read_scenes(shard))
        assert [scene.key for scene in scenes] == [sample.key for sample in samples]
        for scene, sample in zip(scenes, samples, strict=True):
            assert scene.views == sample.views
            assert scene.scene.objects == sample.scene.objects
            assert np.array_equal(scene.scene.vertex_positions, sample.scene.vertex_positions)


def test_samples_are_read_by_key(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    (shard, *_) = dataset.shards_of("train")
    whole = {sample.key: encode_sample(sample) for sample in dataset.read_shard(shard)}
    keys = ["000000001", "000000000"]
    read = list(dataset.read_samples(shard, keys))
    assert [sample.key for sample in read] == keys
    assert [encode_sample(sample) for sample in read] == [whole[key] for key in keys]


def test_a_missing_shard_is_named(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    shard = dataset.manifest.shards[0]
    dataset.folder.shard(shard.name).unlink()
    with pytest.raises(TrilightError, match=rf"{shard.name}.*trilight generate"):
        list(dataset.read_scenes(shard))


def test_a_short_shard_is_named(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    shard = dataset.manifest.shards[0]
    path = dataset.folder.shard(shard.name)
    path.write_bytes(path.read_bytes()[:4096])
    with pytest.raises(TrilightError, match=rf"{shard.name}.*cut short.*trilight verify"):
        list(dataset.read_scenes(shard))


@for_each("name", ["../evil.tar", "/train-000000.tar", "train-0.tar", "x"])
def test_a_hostile_row_is_refused(tmp_path: Path, name: str) -> None:
    dataset = five_scenes(tmp_path)
    shards = json.loads(dataset.folder.manifest.read_text())["shards"]
    shards[0]["name"] = name
    root = edit_manifest(dataset, shards=shards)
    with pytest.raises(TrilightError, match="not a readable manifest"):
        open_dataset(str(root))


def test_a_count_that_is_not_the_shard_s_is_named(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    shards = json.loads(dataset.folder.manifest.read_text())["shards"]
    shards[0]["num_samples"] = 9
    found = open_dataset(str(edit_manifest(dataset, shards=shards)))
    with pytest.raises(TrilightError, match=r"[12] samples; expected 9.*trilight verify"):
        found.keys(found.manifest.shards[0])


def test_manifests_of_version_2_are_read_and_others_refused(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    older = open_dataset(str(edit_manifest(dataset, schema_version=2))).manifest
    assert (older.num_samples, older.schema_version) == (5, 2)
    edit_manifest(dataset, schema_version=1)
    with pytest.raises(TrilightError, match=r"manifest.*version 1; .* reads 2, 3, 4 and 5"):
        open_dataset(str(tmp_path))
