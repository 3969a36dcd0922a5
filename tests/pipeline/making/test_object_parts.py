"""The mesh stage in parts: shared by makers, resumed, remembered, and never of another file."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedAsset
from pipeline.making import object_parts
from pipeline.making.object_parts import Proof, cut_objects, prepare_in_parts
from storage.errors import TrilightError
from storage.records.objects import Failure, ObjectRecord
from tests.pipeline.making.frozen_kit import prepared


class Mesher:
    """Stands for the mesh stage: counts what it is asked for, and fails where it is told to."""

    def __init__(self) -> None:
        self.made: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.at_each: Callable[[], None] = lambda: None

    def prepare(
        self, records: list[ObjectRecord], done: Callable[[], None]
    ) -> tuple[list[PreparedAsset], list[Failure]]:
        assets, failures = [], []
        for record in records:
            self.at_each()
            self.made[record.uid] += 1
            if reason := self.reasons.get(record.uid):
                failures.append(
                    Failure(stage="assets", item=record.uid, reason=reason, message="x")
                )
            else:
                made = vars(prepared(int(record.uid[7:]))) | {"record": record}
                assets.append(PreparedAsset(**made))
            done()
        return assets, failures

    def __enter__(self) -> "Mesher":
        return self

    def __exit__(self, *error: object) -> None:
        """Hold nothing."""


@pytest.fixture
def mesher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Mesher:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(object_parts, "_MEAN_OBJECTS", 4)
    monkeypatch.setattr(object_parts, "_PAUSES_S", (0.001, 0.01))
    mesher = Mesher()
    monkeypatch.setattr(object_parts, "MeshWork", lambda settings, workers: mesher)
    return mesher


def _records(folder: Path, count: int = 30, suffix: str = ".ply") -> list[ObjectRecord]:
    folder.mkdir(exist_ok=True)
    records = []
    for number in range(count):
        path = folder / f"{number}{suffix}"
        if not path.exists():
            path.write_text(str(number))
        records.append(
            ObjectRecord(
                uid=f"object {number:05d}", title="", licence="MIT", licence_source="tests",
                attribution="", source_url="", path=str(path),
            )
        )  # fmt: skip
    return records


def _prepare(records: list[ObjectRecord], shared: Path) -> tuple[Proof, int]:
    counted: list[int] = []
    found = prepare_in_parts(records, AssetSettings(), shared, workers=1, done=counted.append)
    return found, sum(counted)


def test_an_object_more_changes_one_part(tmp_path: Path) -> None:
    records = _records(tmp_path, 1000)
    parts = cut_objects(records)
    assert [one for part in parts for one in part] == records
    assert 5 < len(parts) < 40
    without = cut_objects([record for record in records if record != records[500]])
    assert len([part for part in without if part not in parts]) == 1
    assert cut_objects([]) == []


def test_nothing_is_made_twice(mesher: Mesher, tmp_path: Path) -> None:
    """Not by a maker that goes on, nor for a later dataset; an object more costs its part."""
    records = _records(tmp_path / "objects")
    mesher.reasons["object 00003"] = "no_faces"
    (found, failures), counted = _prepare(records, tmp_path / "one")
    assert [one.record for one in found] == [r for r in records if r.uid != "object 00003"]
    assert [(f.item, f.reason) for f in failures] == [("object 00003", "no_faces")]
    assert counted == 30 == sum(mesher.made.values())
    for shared in ("one", "two"):
        assert _prepare(records, tmp_path / shared) == ((found, failures), 30)
    assert sum(mesher.made.values()) == 30
    more, _ = _prepare(_records(tmp_path / "objects", 31), tmp_path / "two")
    assert len(more[0]) == 30
    assert sum(mesher.made.values()) <= 30 + 16


def test_makers_share_the_parts(mesher: Mesher, tmp_path: Path) -> None:
    records, results = _records(tmp_path / "objects"), []
    mesher.at_each = partial(time.sleep, 0.002)
    threads = [
        threading.Thread(target=lambda: results.append(_prepare(records, tmp_path / "set")))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(mesher.made.values()) == 1 and len(mesher.made) == 30
    assert len(results) == 4
    assert all(result == results[0] for result in results)


def test_a_kill_loses_the_parts_in_hand(
    mesher: Mesher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_parts, "_AT_ONCE", 1)
    records = _records(tmp_path / "objects")

    def die() -> None:
        if sum(mesher.made.values()) == 20:
            raise KeyboardInterrupt

    mesher.at_each = die
    with pytest.raises(KeyboardInterrupt):
        _prepare(records, tmp_path / "set")
    mesher.at_each = lambda: None
    before = Counter(mesher.made)
    (found, _), _ = _prepare(records, tmp_path / "set")
    assert len(found) == 30
    again = {uid for uid, count in mesher.made.items() if count > 1}
    assert again < set(before)
    (part,) = [part for part in cut_objects(records) if again & {r.uid for r in part}]
    assert again <= {record.uid for record in part}


def test_what_the_environment_prevented_is_tried_again(mesher: Mesher, tmp_path: Path) -> None:
    records = _records(tmp_path / "objects")
    mesher.reasons["object 00007"] = "killed"
    (found, failures), _ = _prepare(records, tmp_path / "set")
    assert (len(found), [f.reason for f in failures]) == (29, ["killed"])
    del mesher.reasons["object 00007"]
    for shared in ("set", "another"):
        (found, failures), _ = _prepare(records, tmp_path / shared)
        assert (len(found), failures) == (30, [])
    assert mesher.made["object 00007"] == 2


@pytest.mark.parametrize(
    ("suffix", "changed", "again"),
    [
        (".ply", "9.ply", True),
        (".ply", "beside.bin", False),
        (".gltf", "beside.bin", True),
        (".glb", "sub/deeper.bin", True),
        (".glb", "another.glb", False),
        (".usda", "another.usda", True),
    ],
)
def test_a_file_that_has_changed_is_looked_at(
    mesher: Mesher, tmp_path: Path, suffix: str, changed: str, again: bool
) -> None:
    records = _records(tmp_path / "objects", suffix=suffix)
    _prepare(records, tmp_path / "one")
    path = tmp_path / "objects" / changed
    path.parent.mkdir(exist_ok=True)
    path.write_text("something else")
    _prepare(records, tmp_path / "two")
    assert (max(mesher.made.values()) == 2) == again


@pytest.mark.parametrize("damage", [b"", b"{}\n", b'{"uid": "x"}\n', b"\xff"])
def test_a_damaged_proof_is_none(mesher: Mesher, tmp_path: Path, damage: bytes) -> None:
    records = _records(tmp_path / "objects", 3)
    expected = _prepare(records, tmp_path / "one")
    for path in (tmp_path / "cache" / "object-parts").rglob("*.jsonl"):
        path.write_bytes(damage)
    assert _prepare(records, tmp_path / "two") == expected
    assert max(mesher.made.values()) == 2


def test_of_a_file_of_another_user(
    mesher: Mesher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a cache it is as if it were not there; beside the dataset it is said what to do."""
    records = _records(tmp_path / "objects", 3)
    expected = _prepare(records, tmp_path / "one")
    read = Path.read_bytes
    unreadable = tmp_path / "cache"

    def refused(path: Path) -> bytes:
        if path.is_relative_to(unreadable) and path.exists():
            raise PermissionError(13, "Permission denied", str(path))
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", refused)
    assert _prepare(records, tmp_path / "two") == expected
    unreadable = tmp_path / "two"
    with pytest.raises(TrilightError, match="Permission denied; expected a file that every maker"):
        _prepare(records, tmp_path / "two")
