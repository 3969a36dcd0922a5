"""Objects frozen in parts, attacked: kills between two writes, leftovers of other datasets."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import pytest

from pipeline.making import asked_objects, restore_object
from pipeline.making.pipeline import make_dataset
from pipeline.making.publication import Publication
from pipeline.shards import mirror
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder, dataset_folder
from storage.dataset.splits import part_of_object
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.objects import read_objects_lock
from tests.pipeline.making.bucket_kit import OUT, Killed, Machines, killed_before
from tests.pipeline.making.parts_kit import parts_by_hand, parts_order, textures_in
from tests.pipeline.making.test_lock_parts import SPLITS
from tests.pipeline.making.tiny_scenes_kit import Undocumented

LOCK = "shards/set/objects.lock.jsonl"


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[object]:
    return parts_by_hand(tmp_path, monkeypatch)


def _make(
    out: str, shards: str | None = None, scenes: int = 28, textures: Path | None = None
) -> Any:
    return make_dataset(parts_order(out, scenes, shards, textures), Undocumented())


def _objects(made: list[object]) -> list[str]:
    found = [one for one in made if isinstance(one, str)]
    made.clear()
    return found


def _halved(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Have the source lose every second object; return what it has then."""
    whole = asked_objects.list_objects("", work_dir=Path(), allowed_licences=())
    fewer = whole.allowed[::2]
    listing = dataclasses.replace(whole.listing, records=fewer)
    listed = dataclasses.replace(whole, allowed=fewer, listing=listing)
    monkeypatch.setattr(asked_objects, "list_objects", lambda *asked, **more: listed)
    return {record.uid for record in fewer}


def test_a_range_prepares_no_other_part(
    bucket: Any, machines: Machines, made: list[object]
) -> None:
    """Neither before its shards nor when they are there."""
    machines.use("b")
    _make(OUT, "6:7")
    assert {part_of_object(uid, SPLITS) for uid in _objects(made)} == {1}


def test_a_lock_without_its_index_is_not_prepared_again(
    bucket: Any, machines: Machines, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    machines.use("a")
    with killed_before(monkeypatch, "write", "0000.index"):
        _make(OUT, "0:6")
    assert _objects(made)
    machines.use("b")
    _make(OUT, "0:6")
    assert _objects(made) == []


def test_who_follows_a_killed_maker_sends_the_lock(
    bucket: Any, machines: Machines, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two makers of one machine: the manifest here knew the lock, and the bucket had none."""
    machines.use("a")

    def killed(self: mirror.Mirror) -> None:
        raise Killed

    with dataset_folder(OUT).joined():  # so that the next one does not begin alone
        with monkeypatch.context() as patch:
            patch.setattr(mirror.Mirror, "send_lock", killed)
            with pytest.raises(Killed):
                _make(OUT)
        assert not bucket.exists(LOCK)
        _make(OUT)
    bucket.invalidate_cache()
    assert bucket.exists(LOCK)
    assert verify_dataset(OUT).problems == []


def test_parts_of_a_deleted_dataset_are_none_of_the_next(
    bucket: Any, machines: Machines, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine still has what it froze of the first one; the settings are the same."""
    machines.use("a")
    _make(OUT, "0:6")
    bucket.rm("shards/set", recursive=True)
    bucket.invalidate_cache()
    source = _halved(monkeypatch)
    machines.use("b")
    _make(OUT, "6:7")
    machines.use("a")
    _make(OUT)
    assert {row.uid for row in open_dataset(OUT).objects_lock()} == source
    assert verify_dataset(OUT).problems == []


def test_a_bucket_with_parts_and_no_manifest_is_refused(
    bucket: Any, machines: Machines, made: list[object]
) -> None:
    machines.use("a")
    _make(OUT, "0:6")
    for path in bucket.find("shards/set"):
        if "/.staging/object_locks/" not in path:
            bucket.rm_file(path)
    machines.use("b")
    with pytest.raises(TrilightError, match=r"0000\S* is there but no manifest.json: objects of"):
        _make(OUT, "0:6")


def test_parts_that_were_left_are_none_of_a_new_dataset(
    tmp_path: Path, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`rm -r out/*` leaves .staging; what is made there next is frozen as a whole."""
    out = tmp_path / "set"
    _make(str(out))
    for path in out.iterdir():
        if path.name != ".staging":
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    source = _halved(monkeypatch)
    order = parts_order(str(out), 8)
    whole = {k: v for k, v in order.changes.items() if k != "splits.object_parts"}
    make_dataset(dataclasses.replace(order, changes=whole, seed=5), Undocumented())
    assert {row.uid for row in read_objects_lock(out / "objects.lock.jsonl")} == source


def test_a_kill_before_the_parts_are_joined_is_mended_by_the_next_start(
    tmp_path: Path, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "set"
    _make(str(out), "0:6", 32)

    def killed(self: Publication) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(Publication, "join_lock_parts", killed)
        with pytest.raises(Killed):
            _make(str(out), "6:7", 32)
    _make(str(out), "6:7", 32)  # of 8 shards one is missing still
    assert len(read_objects_lock(out / "objects.lock.jsonl")) == 60


def test_textures_are_looked_at_once_after_staging_was_deleted(
    tmp_path: Path, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, textures = tmp_path / "set", textures_in(tmp_path / "textures", 1, 2)
    _make(str(out), scenes=8, textures=textures)
    shutil.rmtree(DatasetFolder(out).staged_locks)
    listed, looks = asked_objects.list_objects, list[str]()

    def looked(source: str, **more: Any) -> Any:
        looks.append(source)
        return listed(source, **more)

    monkeypatch.setattr(asked_objects, "list_objects", looked)
    for _ in range(3):
        _make(str(out), scenes=8, textures=textures)
    assert len(looks) <= 2, "once by who shares the work, once by who freezes"


def test_a_dataset_that_grows_verifies_until_it_is_listed_anew(
    bucket: Any, machines: Machines, made: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    machines.use("a")
    _make(OUT, scenes=24)
    seen, notes = list[str](), mirror.Mirror.notes

    def looked(self: mirror.Mirror, names: Any) -> Any:
        seen.extend(["looked", *verify_dataset(OUT).problems])
        return notes(self, names)

    monkeypatch.setattr(mirror.Mirror, "notes", looked)
    machines.use("b")
    _make(OUT, scenes=28)
    assert set(seen) == {"looked"}


def test_rejections_are_those_of_the_part_that_was_frozen(bucket: Any, machines: Machines) -> None:
    with machines.maker("a"):
        found = mirror.Mirror(dataset_folder(OUT))
        path = dataset_folder(OUT).lock_part("0000")
        row = b'{"stage": "assets", "item": "%s", "reason": "x", "message": "y"}\n'
        found.freeze_part(path, b'{"uid": "a"}\n', row % b"of a")
        with pytest.raises(TrilightError, match="in the meantime"):
            found.freeze_part(path, b'{"uid": "b"}\n', row % b"of b")
        assert [failure.item for failure in found.take_parts_of_lock()] == ["of a"]


def test_an_object_that_is_there_again_is_found(tmp_path: Path) -> None:
    """A worker that lives long has listed the source before."""
    asked = ("builtin:4", None, tmp_path / "objects", ("MIT", "CC0-1.0"))
    uid = restore_object._listed(*asked).allowed[0].uid
    shutil.rmtree(tmp_path / "objects")
    record = restore_object.found_again(*asked, uid)
    assert record is not None and Path(record.path).exists()
