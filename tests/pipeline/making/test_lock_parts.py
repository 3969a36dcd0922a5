"""Objects frozen in parts: scenes begin with the first, and what is frozen never changes."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from pipeline.builds.named import named_build
from pipeline.making import accept_objects as accepting
from pipeline.making import asked_objects, object_parts, pipeline
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.lock_parts import LockPart, lock_parts
from pipeline.making.pipeline import make_dataset
from pipeline.making.publication import Publication
from pipeline.objects.sources import FoundObjects
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import part_of_object, part_of_shard, split_of_shard
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.objects import read_objects_lock
from tests.pipeline.making.test_object_parts import Mesher, _records
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

PARTS = 2
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


def test_what_does_not_go_together_is_refused() -> None:
    with pytest.raises(TrilightError, match="expected 1 where scenes are listed"):
        dataclasses.replace(SPLITS, listed_scenes=4)
    bucket = DatasetFolder(Path("x"), "s3://bucket/set")
    with pytest.raises(TrilightError, match="s3://bucket/set: .* expected 1 for a dataset in a"):
        lock_parts(bucket, SPLITS, [0])
    with pytest.raises(TrilightError, match="expected 1 beside --textures or --skies"):
        lock_parts(DatasetFolder(Path("x")), SPLITS, [0], maps=True)


@pytest.fixture
def made_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Objects and scenes in the order in which a run makes them; nothing is rendered."""
    order: list[object] = []
    accept, share = pipeline.accept_objects, pipeline.share_mesh_work
    without_rendering(monkeypatch, order.append)
    monkeypatch.setattr(pipeline, "accept_objects", accept)
    monkeypatch.setattr(pipeline, "share_mesh_work", share)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    mesher = Mesher()
    monkeypatch.setattr(object_parts, "MeshWork", lambda settings, workers: mesher)
    records = _records(tmp_path / "objects", 60)
    found = FoundObjects(records=tuple(records), failures=())
    monkeypatch.setattr(asked_objects, "find_objects", lambda *asked, **more: found)
    prepare = mesher.prepare

    def noted(records, done):  # type: ignore[no-untyped-def]
        order.extend(record.uid for record in records)
        return prepare(records, done)

    monkeypatch.setattr(mesher, "prepare", noted)
    monkeypatch.setattr(
        accepting,
        "prepare_isolated",
        lambda records, settings, *, workers, done: prepare(records, done),
    )
    return order


def _order(out: Path, scenes: int) -> DatasetOrder:
    changes = {"scenes.num_views": 2, "splits.object_parts": PARTS, "splits.shards_per_cycle": 6}
    return tiny_order(out=str(out), objects="builtin:", scenes=scenes, changes=changes)


def test_scenes_begin_with_the_first_part(tmp_path: Path, made_in_order: list[object]) -> None:
    """A longer dataset goes on with the other part; what was frozen stays, and all verifies."""
    out = tmp_path / "set"
    make_dataset(_order(out, 8), Undocumented())  # two shards of the first cycle
    objects = [uid for uid in made_in_order if isinstance(uid, str)]
    assert made_in_order == [*objects, *range(8)]
    splits = _splits(out)
    assert {part_of_object(uid, splits) for uid in objects} == {0}
    first = read_objects_lock(out / "objects.lock.jsonl")
    assert [row.uid for row in first] == sorted(objects)
    made_in_order.clear()
    outcome = make_dataset(_order(out, 28), Undocumented())  # into the second cycle
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
    assert make_dataset(_order(out, 28), Undocumented()).digest == outcome.digest
    assert made_in_order == [0, 1, 2, 3]
    assert read_objects_lock(out / "objects.lock.jsonl") == later


def test_a_kill_between_lock_and_manifest_leaves_a_part_to_be_frozen(
    tmp_path: Path, made_in_order: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "set"
    make_dataset(_order(out, 8), Undocumented())
    before = (out / "objects.lock.jsonl").read_bytes()

    def killed(publication: Publication, **changes: object) -> None:
        if "objects_lock_sha256" in changes:
            raise KeyboardInterrupt
        write(publication, **changes)

    write = Publication._write
    monkeypatch.setattr(Publication, "_write", killed)
    with pytest.raises(KeyboardInterrupt):
        make_dataset(_order(out, 28), Undocumented())
    assert (out / "objects.lock.jsonl").read_bytes() != before
    monkeypatch.setattr(Publication, "_write", write)
    make_dataset(_order(out, 28), Undocumented())
    frozen = open_dataset(str(out)).manifest.objects_lock_sha256
    assert frozen == sha256_of_file(out / "objects.lock.jsonl")
    assert len(read_objects_lock(out / "objects.lock.jsonl")) == 60


def _splits(out: Path) -> SplitSettings:
    splits = open_dataset(str(out)).manifest.settings["splits"]
    return SplitSettings(**splits)
