"""The mesh stage in batches: shared by workers, resumed, remembered, and never of another file."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.assets.settings import AssetSettings
from pipeline.making.object_batches import (
    ObjectWork,
    PrepareResult,
    cut_objects,
    prepare_in_batches,
)
from pipeline.objects.listing import Fetched, failure
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from tests.pipeline.making.frozen_kit import Mesher, begun, object_records, use_mesher


@pytest.fixture
def mesher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Mesher:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    return use_mesher(monkeypatch, batch=8)


def _prepare(
    records: list[ObjectRecord],
    out: Path,
    fetch: Callable[[list[ObjectRecord]], Fetched] | None = None,
) -> tuple[PrepareResult, int]:
    counted: list[int] = []
    work = ObjectWork(settings=AssetSettings(), publication=begun(out), fetch=fetch)
    found = prepare_in_batches(records, work, workers=1, done=counted.append)
    return found, sum(counted)


def test_nothing_is_made_twice(mesher: Mesher, tmp_path: Path) -> None:
    """Not by a worker that resumes, nor for a later dataset; an object more costs its batch."""
    records = object_records(tmp_path / "objects")
    mesher.reasons["object 00003"] = "no_faces"
    (found, failures), counted = _prepare(records, tmp_path / "one")
    assert [one.record for one in found] == [r for r in records if r.uid != "object 00003"]
    assert [(f.item, f.reason) for f in failures] == [("object 00003", "no_faces")]
    assert counted == 30 == sum(mesher.made.values())
    for out in ("one", "two"):
        assert _prepare(records, tmp_path / out) == ((found, failures), 30)
    assert sum(mesher.made.values()) == 30
    _prepare(object_records(tmp_path / "objects", 31), tmp_path / "two")
    assert sum(mesher.made.values()) == 30 + 7


def test_a_kill_loses_the_batches_in_hand(mesher: Mesher, tmp_path: Path) -> None:
    records = object_records(tmp_path / "objects")

    def die(uid: str) -> None:
        if sum(mesher.made.values()) == 20:
            raise KeyboardInterrupt

    mesher.before_each = die
    with pytest.raises(KeyboardInterrupt):
        _prepare(records, tmp_path / "set")
    mesher.before_each = lambda uid: None
    (found, _), _ = _prepare(records, tmp_path / "set")
    assert len(found) == 30
    again = {uid for uid, count in mesher.made.items() if count > 1}
    lost = [batch for batch in cut_objects(records) if again & {r.uid for r in batch}]
    assert len(lost) <= 2


def test_what_the_environment_prevented_is_tried_again(mesher: Mesher, tmp_path: Path) -> None:
    records = object_records(tmp_path / "objects")
    mesher.reasons["object 00007"] = "killed"
    (found, failures), _ = _prepare(records, tmp_path / "set")
    assert (len(found), [f.reason for f in failures]) == (29, ["killed"])
    del mesher.reasons["object 00007"]
    for out in ("set", "another"):
        (found, failures), _ = _prepare(records, tmp_path / out)
        assert (len(found), failures) == (30, [])
    assert mesher.made["object 00007"] == 2


def test_only_what_is_prepared_is_fetched(mesher: Mesher, tmp_path: Path) -> None:
    """A download that failed is tried again, with its batch; a later dataset prepares nothing."""
    records = object_records(tmp_path / "cache" / "objects")
    listed = [dataclasses.replace(record, path="") for record in records]
    lost, fetched = {"object 00012"}, list[str]()

    def fetch(asked: list[ObjectRecord]) -> Fetched:
        fetched.extend(record.uid for record in asked)
        uids = {record.uid for record in asked} - lost
        failures = [failure(uid, "download_failed", "x") for uid in lost & {r.uid for r in asked}]
        return [record for record in records if record.uid in uids], failures

    (found, failures), counted = _prepare(listed, tmp_path / "set", fetch)
    assert (len(found), [f.item for f in failures], counted) == (29, ["object 00012"], 30)
    assert sorted(fetched) == [record.uid for record in records]
    lost.clear()
    fetched.clear()
    expected = _prepare(listed, tmp_path / "set", fetch)
    assert len(expected[0][0]) == 30
    assert fetched == [record.uid for record in listed[8:16]]
    made = sum(mesher.made.values())
    assert _prepare(listed, tmp_path / "two", fetch) == expected
    assert sum(mesher.made.values()) == made


def test_a_file_that_has_changed_is_looked_at(mesher: Mesher, tmp_path: Path) -> None:
    cases = [
        (".ply", "object 00009.ply", True),
        (".ply", "beside.bin", False),
        (".gltf", "beside.bin", True),
        (".glb", "sub/deeper.bin", True),
        (".glb", "another.glb", False),
        (".usda", "another.usda", True),
    ]
    for number, (suffix, changed, is_made_again) in enumerate(cases):
        folder = tmp_path / f"objects{number}"
        records = object_records(folder, suffix=suffix)
        mesher.made.clear()
        _prepare(records, tmp_path / f"{number}-one")
        path = folder / changed
        path.parent.mkdir(exist_ok=True)
        path.write_text("something else")
        _prepare(records, tmp_path / f"{number}-two")
        assert (max(mesher.made.values()) == 2) == is_made_again, (suffix, changed)


def test_a_damaged_result_is_made_again(mesher: Mesher, tmp_path: Path) -> None:
    records = object_records(tmp_path / "objects", 3)
    expected = _prepare(records, tmp_path / "one")
    for number, damage in enumerate((b"", b"{}\n", b'{"uid": "x"}\n', b"\xff")):
        for path in (tmp_path / "cache" / "object-batches").rglob("*.jsonl"):
            path.write_bytes(damage)
        assert _prepare(records, tmp_path / f"again{number}") == expected
        assert max(mesher.made.values()) == 2 + number


def test_a_file_of_another_user(
    mesher: Mesher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a cache it counts as missing; beside the dataset the error names the next step."""
    records = object_records(tmp_path / "objects", 3)
    expected = _prepare(records, tmp_path / "one")
    read = Path.read_bytes
    unreadable = tmp_path / "cache"

    def refused(path: Path) -> bytes:
        if path.is_relative_to(unreadable) and path.suffix == ".jsonl" and path.exists():
            raise PermissionError(13, "Permission denied", str(path))
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", refused)
    assert _prepare(records, tmp_path / "two") == expected
    unreadable = tmp_path / "two"
    with pytest.raises(TrilightError, match="Permission denied; expected a file that every worker"):
        _prepare(records, tmp_path / "two")
