"""Croissant passes MLCommons' own validator, and a huge dataset is described by a sample."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.documents import croissant
from pipeline.documents.croissant import encode_croissant
from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.distributions import dataset_distributions
from pipeline.documents.rights import rights_of
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.statistics import dataset_statistics, described_shards
from storage.records.objects import read_objects_lock
from tests.pipeline.documents.dataset_by_hand import five_scenes, locked, sample, write_dataset
from tests.scenes_by_hand import tiny_scene


@pytest.fixture
def mlcroissant() -> Any:
    return pytest.importorskip("mlcroissant", reason="run make setup-all")


def _write(root: Path) -> Path:
    dataset = five_scenes(root)
    rights = rights_of(read_objects_lock(dataset.folder.objects_lock))
    dataset.folder.croissant.write_bytes(encode_croissant(dataset.manifest, rights))
    return dataset.folder.croissant


def test_the_validator_has_no_error_and_every_shard_and_scene_is_found(
    mlcroissant: Any, tmp_path: Path
) -> None:
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


def test_a_dataset_without_shards_is_valid_too(mlcroissant: Any, tmp_path: Path) -> None:
    manifest = dataclasses.replace(five_scenes(tmp_path / "a").manifest, shards=())
    path = tmp_path / "croissant.json"
    path.write_bytes(encode_croissant(manifest, rights_of([])))
    assert not mlcroissant.Dataset(jsonld=str(path)).metadata.ctx.issues.errors


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Return 11 shards of one scene each, one of them for testing."""
    shards = {f"train-{row:06d}.tar": [sample(row, tiny_scene())] for row in range(10)}
    return write_dataset(
        tmp_path / "set", {**shards, "test-000010.tar": [sample(10, tiny_scene())]}
    )


def test_shards_are_spread_over_each_split(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage.dataset.statistics.MOST_SCENES", 11)
    assert described_shards(dataset) == list(dataset.manifest.shards)
    monkeypatch.setattr("storage.dataset.statistics.MOST_SCENES", 4)
    names = [shard.name for shard in described_shards(dataset)]
    assert names == ["test-000010.tar", *(f"train-{row:06d}.tar" for row in (0, 3, 6, 9))]


@pytest.mark.usefixtures("bare_reports")
def test_documents_of_a_sample_say_so(
    mlcroissant: Any, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = dataset_statistics(dataset)
    assert whole.scene_digest and "what follows is" not in dict(whole.lines())
    monkeypatch.setattr("storage.dataset.statistics.MOST_SCENES", 4)
    monkeypatch.setattr(croissant, "MOST_LISTED", 3)
    out = DatasetFolder(tmp_path / "documents")
    out.root.mkdir()
    statistics = write_documents(dataset, out)
    said = "of a sample of 5 of 11 scenes"
    lines = dict(statistics.lines())
    assert lines["what follows is"] == said and "scene digest" not in lines
    assert lines["scenes"] == "11 (1 test, 10 train)" and statistics.num_views == 10
    assert f"Views, errors and contents are those {said}." in out.card.read_text()
    assert said in out.report.read_text()
    assert dataset_distributions(dataset).sample == said
    record = json.loads(out.croissant.read_bytes())
    assert "train-000000.tar" not in json.dumps(record)  # 250,000 of them would take 200 MB
    assert not mlcroissant.Dataset(jsonld=str(out.croissant)).metadata.issues.errors
