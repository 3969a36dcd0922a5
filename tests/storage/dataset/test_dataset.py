"""Reading through the manifest's index: the same scenes as the whole shard, and nothing else."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from storage.dataset.dataset import open_dataset
from storage.errors import TrilightError
from storage.records.sample import encode_sample
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
    with pytest.raises(TrilightError, match=rf"{shard.name}.*shorter.*trilight verify"):
        list(dataset.read_scenes(shard))


@pytest.mark.parametrize(
    "member",
    [
        ["../evil.json", 0, 1],
        ["/evil.json", 0, 1],
        ["a/b.json", 0, 1],
        ["nosuffix", 0, 1],
        ["a.json", -1, 1],
        ["a.json", 0, -1],
        ["a.json", 0, 1 << 40],
    ],
)
def test_a_hostile_index_is_refused(tmp_path: Path, member: list[Any]) -> None:
    dataset = five_scenes(tmp_path)
    shards = json.loads(dataset.folder.manifest.read_text())["shards"]
    shards[0]["members"].append(member)
    root = edit_manifest(dataset, shards=shards)
    with pytest.raises(TrilightError, match="not a readable manifest"):
        open_dataset(str(root))


def test_manifests_of_version_2_are_read_and_others_refused(tmp_path: Path) -> None:
    dataset = five_scenes(tmp_path)
    older = open_dataset(str(edit_manifest(dataset, schema_version=2))).manifest
    assert (older.num_samples, older.schema_version) == (5, 2)
    edit_manifest(dataset, schema_version=1)
    with pytest.raises(TrilightError, match=r"manifest.*version 1; this Trilight reads 2, 3 and 4"):
        open_dataset(str(tmp_path))
