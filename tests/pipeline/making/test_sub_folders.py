"""No folder of a dataset grows without bound, and small datasets look as they always did."""

import json
from pathlib import Path

import pytest

from pipeline.making.publication import Publication
from pipeline.objects.generated import generate_objects
from storage.dataset import layout
from storage.dataset.dataset import open_dataset
from storage.dataset.manifest import index_shard, read_manifest
from storage.dataset.progress import read_progress
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import shard_name
from storage.dataset.staging import is_staged, stage_scene
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.sample import sample_key
from tests.for_each import for_each
from tests.pipeline.documents.dataset_by_hand import edit_manifest
from tests.pipeline.making.test_publication import _dataset, _sample

LIMIT = 4096 + 900
"""Files of one folder, its parts (244 of a million shards) and what else lies there."""


@pytest.fixture()
def two_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two files in a folder stand for 4,096: the rule is the same."""
    monkeypatch.setattr(layout, "FILES_PER_FOLDER", 2)


def _most_entries(root: Path) -> int:
    folders = [root, *(path for path in root.rglob("*") if path.is_dir())]
    return max(sum(1 for _ in folder.glob("[a-z0-9]*[0-9].*")) for folder in folders)


def test_the_first_shards_stay_where_the_design_has_them() -> None:
    splits = SplitSettings(scenes_per_shard=4)
    assert shard_name(0, splits) == "train-000000.tar"
    assert shard_name(4093, splits) == "test-004093.tar"
    assert shard_name(4096, splits) == "part-0001/train-004096.tar"
    assert shard_name(999_999, splits) == "part-0244/train-999999.tar"


def test_a_million_shards_fill_no_folder_beyond_the_limit() -> None:
    folders: dict[str, int] = {}
    for index in range(0, 1_000_000, 8):  # eight that follow each other have one folder
        folder, _, _ = layout.numbered(index, "x").rpartition("/")
        folders[folder] = folders.get(folder, 0) + 8
    assert layout.FILES_PER_FOLDER % 8 == 0
    assert max(folders.values()) + len(folders) < LIMIT < 5000


@pytest.mark.usefixtures("two_each")
def test_a_dataset_in_parts_is_whole(tmp_path: Path) -> None:
    """Shards, rejections and logs move together; reading and verifying find them."""
    publication = _dataset(tmp_path, scenes=20)
    names = [shard.name for shard in publication.manifest.shards]
    assert names == [
        "train-000000.tar", "train-000001.tar", "part-0001/validation-000002.tar",
        "part-0001/train-000003.tar", "part-0002/train-000004.tar",
    ]  # fmt: skip
    assert read_manifest(tmp_path / "manifest.json") == publication.manifest
    found = verify_dataset(tmp_path)
    assert (found.problems, found.num_samples) == ([], 20)
    dataset = open_dataset(str(tmp_path))
    keys = [s.key for shard in dataset.manifest.shards for s in dataset.read_shard(shard)]
    assert keys == [sample_key(index) for index in range(20)]
    assert _most_entries(tmp_path) == 2
    assert publication.missing_shards() == []
    assert read_progress(publication.folder).scenes_done == 20


@pytest.mark.usefixtures("two_each")
def test_a_dataset_grows_into_parts(tmp_path: Path) -> None:
    before = _dataset(tmp_path, scenes=8).manifest
    grown = _dataset(tmp_path, scenes=16).manifest
    assert grown.shards[:2] == before.shards
    assert verify_dataset(tmp_path).problems == []


@pytest.mark.usefixtures("two_each")
def test_a_shard_in_a_part_is_missed_found_and_unlisted(tmp_path: Path) -> None:
    publication = _dataset(tmp_path, scenes=16)
    path = tmp_path / publication.manifest.shards[3].name
    moved = path.rename(tmp_path / "away")
    assert verify_dataset(tmp_path).problems == ["part-0001/train-000003.tar: missing"]
    assert publication.missing_shards() == [3]
    moved.rename(path)
    assert index_shard(path) == publication.manifest.shards[3]
    path.with_name("train-000009.tar").write_bytes(b"")
    assert verify_dataset(tmp_path).problems == ["part-0001/train-000009.tar: not in the manifest"]


@pytest.mark.usefixtures("two_each")
def test_staged_scenes_and_built_in_objects_stand_in_parts(tmp_path: Path) -> None:
    for index in range(5):
        stage_scene(tmp_path / "shard", index, _sample(index), [], "lossless")
    assert all(is_staged(tmp_path / "shard", index) for index in range(5))
    objects = generate_objects("builtin:30", tmp_path / "objects")
    assert len({entry.uid for entry in objects}) == 30
    assert all("part" not in entry.uid for entry in objects)
    assert _most_entries(tmp_path) == 2


@for_each(
    "name",
    ["../train-000000.tar", "part-0001/../train-000000.tar", "/train-000000.tar",
     "part-1/train-000000.tar", "a/train-000000.tar", "part-0001/part-0001/train-000000.tar"],
)  # fmt: skip
def test_a_manifest_that_names_a_file_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    publication: Publication = _dataset(tmp_path, scenes=4)
    shards = json.loads(publication.folder.manifest.read_text())["shards"]
    root = edit_manifest(open_dataset(str(tmp_path)), shards=[{**shards[0], "name": name}])
    with pytest.raises(TrilightError, match="shard name"):
        open_dataset(str(root))
