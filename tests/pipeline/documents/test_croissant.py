"""`croissant.json` passes MLCommons' own validator, and leads it to the data."""

import dataclasses
import json
from pathlib import Path

import pytest

from pipeline.documents.croissant import encode_croissant
from pipeline.documents.rights import rights_of
from storage.dataset.dataset import open_dataset
from storage.records.objects import read_objects_lock
from tests.pipeline.documents.dataset_by_hand import five_scenes, locked

mlcroissant = pytest.importorskip(
    "mlcroissant", reason="mlcroissant is not installed; run make setup-all"
)


def _write(root: Path) -> Path:
    dataset = five_scenes(root)
    rights = rights_of(read_objects_lock(dataset.folder.objects_lock))
    dataset.folder.croissant.write_bytes(encode_croissant(dataset.manifest, rights))
    return dataset.folder.croissant


def test_the_validator_has_no_error_and_misses_only_what_knows_the_clock(tmp_path: Path) -> None:
    read = mlcroissant.Dataset(jsonld=str(_write(tmp_path)))
    issues = read.metadata.ctx.issues
    assert not issues.errors
    missed = {message.split('"')[1].rsplit("/", 1)[-1] for message in map(str, issues.warnings)}
    assert missed == {"citeAs", "datePublished"}
    assert read.metadata.ctx.conforms_to.value == "http://mlcommons.org/croissant/1.1"
    assert sorted(read.metadata.license) == [
        "https://spdx.org/licenses/CC-BY-4.0.html",
        "https://spdx.org/licenses/CC0-1.0.html",
    ]


def test_it_leads_to_every_shard_and_scene(tmp_path: Path) -> None:
    read = mlcroissant.Dataset(jsonld=str(_write(tmp_path)))
    dataset = open_dataset(str(tmp_path))
    manifest = dataset.manifest
    files = {entry.id: entry.sha256 for entry in read.metadata.file_objects}
    assert files == {shard.name: shard.sha256 for shard in manifest.shards}
    scenes = {row["scenes/key"].decode(): row["scenes/json"] for row in read.records("scenes")}
    assert sorted(scenes) == sorted(key for shard in manifest.shards for key in dataset.keys(shard))
    assert json.loads(scenes["000000020"])["provenance"]["template"] == "wall"
    assert [row["splits/name"] for row in read.records("splits")] == ["train", "test"]


@pytest.mark.parametrize("licence", ['"}, {', "x\n\ud800", "LicenseRef-a"])
def test_it_is_json_whatever_the_licences_are_called(tmp_path: Path, licence: str) -> None:
    dataset = five_scenes(tmp_path)
    document = json.loads(encode_croissant(dataset.manifest, rights_of([locked("a", licence)])))
    assert document["license"] == [licence]


def test_a_dataset_without_shards_is_valid_too(tmp_path: Path) -> None:
    manifest = dataclasses.replace(five_scenes(tmp_path / "a").manifest, shards=())
    path = tmp_path / "croissant.json"
    path.write_bytes(encode_croissant(manifest, rights_of([])))
    assert not mlcroissant.Dataset(jsonld=str(path)).metadata.ctx.issues.errors
