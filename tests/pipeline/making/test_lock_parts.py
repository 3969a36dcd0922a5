"""Objects frozen in parts: scenes begin with the first, and what is frozen never changes."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from pipeline.builds.named import named_build
from pipeline.making.lock_parts import LockPart
from pipeline.making.pipeline import make_dataset
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import part_of_object, part_of_shard, split_of_shard
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.objects import read_objects_lock
from tests.pipeline.making.parts_kit import PARTS, parts_by_hand, parts_order
from tests.pipeline.making.tiny_scenes_kit import Undocumented

SPLITS = SplitSettings(scenes_per_shard=4, shards_per_cycle=6, object_parts=PARTS)


def test_every_part_has_shards_of_all_splits() -> None:
    found = {(part_of_shard(n, SPLITS), split_of_shard(n, SPLITS)) for n in range(6 * PARTS)}
    assert len(found) == 3 * PARTS
    one_split = dataclasses.replace(SPLITS, one_split=True)
    assert [part_of_shard(n, one_split) for n in range(4)] == [0, 1, 0, 1]


def test_parts_of_objects_follow_from_their_uids() -> None:
    parts = [part_of_object(f"object {n}", SPLITS) for n in range(400)]
    assert all(150 < parts.count(part) < 250 for part in range(PARTS))
    assert {part_of_object("a", dataclasses.replace(SPLITS, object_parts=1))} == {0}


def test_one_part_leaves_the_record_as_it_was() -> None:
    build = named_build("smoke")
    assert "object_parts" not in build.as_json()["splits"]
    parts = dataclasses.replace(build, splits=dataclasses.replace(build.splits, object_parts=2))
    assert parts.as_json()["splits"]["object_parts"] == 2
    assert parts.digest != build.digest


def test_of_listed_scenes_no_object_is_drawn() -> None:
    with pytest.raises(TrilightError, match="expected 1 where scenes are listed"):
        dataclasses.replace(SPLITS, listed_scenes=4)


@pytest.fixture
def made_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    return parts_by_hand(tmp_path, monkeypatch)


def test_scenes_begin_with_the_first_part(tmp_path: Path, made_in_order: list[object]) -> None:
    """A longer dataset goes on with the other part; what was frozen stays, and all verifies."""
    out = tmp_path / "set"
    make_dataset(parts_order(str(out), 8), Undocumented())  # two shards of the first cycle
    objects = [uid for uid in made_in_order if isinstance(uid, str)]
    assert made_in_order == [*objects, *range(8)]
    splits = _splits(out)
    assert {part_of_object(uid, splits) for uid in objects} == {0}
    first = read_objects_lock(out / "objects.lock.jsonl")
    assert [row.uid for row in first] == sorted(objects)
    made_in_order.clear()
    outcome = make_dataset(parts_order(str(out), 28), Undocumented())  # into the second cycle
    later = read_objects_lock(out / "objects.lock.jsonl")
    assert outcome.num_objects_used == len(later) == 60
    assert [row for row in later if row.uid in objects] == first
    kinds = [type(one) for one in made_in_order]
    changes = [kind for n, kind in enumerate(kinds) if n == 0 or kind != kinds[n - 1]]
    assert changes == [int, str, int]  # the first part was frozen before
    assert open_dataset(str(out)).manifest.num_scenes == 28
    folder = DatasetFolder(out)
    for number in range(PARTS):
        part = LockPart(folder=folder, splits=splits, number=number)
        expected = [row for row in later if part_of_object(row.uid, splits) == number]
        assert list(LockRows(part.lock)) == expected
    shutil.rmtree(folder.staged_locks)  # as whoever deletes .staging
    (out / "train-000000.tar").unlink()
    made_in_order.clear()
    assert make_dataset(parts_order(str(out), 28), Undocumented()).digest == outcome.digest
    assert made_in_order == [0, 1, 2, 3]
    assert read_objects_lock(out / "objects.lock.jsonl") == later


def _splits(out: Path) -> SplitSettings:
    splits = open_dataset(str(out)).manifest.settings["splits"]
    return SplitSettings(**splits)
