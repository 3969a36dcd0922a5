"""Sources: what is listed, under which names, and every mistake in a folder or a catalogue."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from pipeline.assets.source_file import SUFFIXES as READABLE
from pipeline.objects.folder import SUFFIXES
from pipeline.objects.licences import DEFAULT_ALLOWED, USER_PROVIDED, refuse_licences
from pipeline.objects.names import printable
from pipeline.objects.sources import list_objects
from storage.errors import TrilightError
from storage.records import ObjectRecord


def touch(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("v 0 0 0")


def write_catalogue(folder: Path, *rows: Any) -> None:
    lines = [row if isinstance(row, str) else json.dumps(row) for row in rows]
    (folder / "objects.jsonl").write_text("\n".join(lines) + "\n")


def listed(folder: Path, work_dir: Path | None = None) -> list[ObjectRecord]:
    return list_objects(str(folder), work_dir=work_dir or folder / "unused")


def test_what_is_listed_is_what_is_read() -> None:
    """Stages do not import each other, so the list of formats stands in both."""
    assert SUFFIXES == READABLE


def test_a_folder_is_listed_at_any_depth_in_order(tmp_path: Path) -> None:
    touch(tmp_path, "b.OBJ", "a/z/deep.gltf.glb", "a/c.ply", "notes.txt", "a.bin", ".hidden.obj")
    touch(tmp_path, "__pycache__/x.off", ".git/y.obj")
    records = listed(tmp_path)
    assert [record.uid for record in records] == ["__pycache__/x", "a/c", "a/z/deep", "b"]
    assert [record.title for record in records] == ["x", "c", "deep", "b"]
    assert {record.licence for record in records} == {USER_PROVIDED}
    assert all(Path(record.path).is_absolute() for record in records)
    assert all(Path(record.path).read_text() == "v 0 0 0" for record in records)
    assert not (tmp_path / "unused").exists()


def test_names_of_any_bytes_become_printable_uids(tmp_path: Path) -> None:
    for name in (b"line\nbreak.obj", b"latin-\xe9.obj", "größe.obj".encode()):
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)).write_text("v 0 0 0")
    records = listed(tmp_path)
    assert [record.uid for record in records] == ["größe", r"latin-\xe9", r"line\nbreak"]
    for record in records:
        json.dumps(vars(record) | {"path": ""}, ensure_ascii=False).encode()
        assert Path(record.path).read_text() == "v 0 0 0"


@pytest.mark.parametrize("text", ["plain", "größe", "a b", "日本"])
def test_printable_text_stays(text: str) -> None:
    assert printable(text) == text


def test_two_files_with_one_uid_are_named(tmp_path: Path) -> None:
    touch(tmp_path, "chair.obj", "chair.glb")
    with pytest.raises(TrilightError, match=r"chair\.obj.*'chair'.*chair\.glb"):
        listed(tmp_path)


def test_links_stay_inside(tmp_path: Path) -> None:
    folder = tmp_path / "objects"
    touch(folder, "a.obj")
    (folder / "b.obj").symlink_to(folder / "a.obj")
    assert [record.uid for record in listed(folder)] == ["a", "b"]
    touch(tmp_path, "outside.obj")
    (folder / "c.obj").symlink_to(tmp_path / "outside.obj")
    with pytest.raises(TrilightError, match=r"c\.obj: is a link out"):
        listed(folder)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.write_text(""), "is not a folder"),
        (lambda path: path.mkdir(), "holds no object"),
        (lambda path: touch(path, "readme.txt", "sub/a.jpg"), "holds no object"),
        (lambda path: touch(path, "objects.jsonl"), "not JSON"),
    ],
)
def test_folders_without_objects(tmp_path: Path, make, message: str) -> None:  # type: ignore[no-untyped-def]
    make(tmp_path / "objects")
    with pytest.raises(TrilightError, match=message) as caught:
        listed(tmp_path / "objects")
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_catalogue_holds_no_object(tmp_path: Path) -> None:
    touch(tmp_path, "a.obj")
    (tmp_path / "objects.jsonl").write_text("\n")
    with pytest.raises(TrilightError, match=r"holds no object.*objects\.jsonl"):
        listed(tmp_path)


def test_a_catalogue_rules_its_folder(tmp_path: Path) -> None:
    touch(tmp_path, "files/one.obj", "files/two.obj", "unlisted.obj")
    write_catalogue(
        tmp_path,
        {"uid": "two", "path": "files/two.obj", "licence": "CC0-1.0", "title": "Two\n\ud800"},
        "",
        {"uid": "one", "path": "files/one.obj", "attribution": "A", "source_url": "u", "x": 1},
        {"uid": "gone", "path": "files/gone.obj", "licence": "MIT"},
    )
    gone, one, two = listed(tmp_path)
    assert (two.title, two.licence) == (r"Two\n\ud800", "CC0-1.0")
    assert (one.title, one.licence) == ("one", "LicenseRef-unknown")
    assert (one.attribution, one.source_url) == ("A", "u")
    assert Path(one.path) == tmp_path.resolve() / "files" / "one.obj"
    assert not Path(gone.path).exists()


GOOD = {"uid": "a", "path": "a.obj"}


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{not json", "objects.jsonl:2: not JSON"),
        ("[" * 100_000, "objects.jsonl:2: not JSON"),
        ([1, 2], "objects.jsonl:2: got a list"),
        ({"path": "a.obj"}, "objects.jsonl:2: field 'uid' is missing"),
        ({"uid": "b"}, "objects.jsonl:2: field 'path' is missing"),
        ({"uid": 7, "path": "a.obj"}, "objects.jsonl:2: field 'uid' is a int"),
        ({"uid": "b", "path": "a.obj", "licence": None}, "field 'licence' is a NoneType"),
        ({"uid": " ", "path": "a.obj"}, "not blank"),
        ({"uid": "b\n", "path": "a.obj"}, "printable"),
        ({"uid": "a", "path": "b.obj"}, "objects.jsonl:2: uid 'a' is already used in line 1"),
        ({"uid": "b", "path": ""}, "expected the name of a file"),
        ({"uid": "b", "path": "a\u0000b"}, "expected the name of a file"),
        ({"uid": "b", "path": "\ud800"}, "expected the name of a file"),
        ({"uid": "b", "path": "."}, "leads out"),
        ({"uid": "b", "path": "../secret.obj"}, "leads out"),
        ({"uid": "b", "path": "x/../../secret.obj"}, "leads out"),
        ({"uid": "b", "path": "/etc/hostname"}, "leads out"),
        ({"uid": "b", "path": "link.obj"}, "leads out"),
    ],
)
def test_mistakes_in_a_catalogue_are_placed(tmp_path: Path, row: Any, message: str) -> None:
    folder = tmp_path / "objects"
    touch(tmp_path, "secret.obj")
    touch(folder, "a.obj")
    (folder / "link.obj").symlink_to(tmp_path / "secret.obj")
    write_catalogue(folder, GOOD, row)
    with pytest.raises(TrilightError, match="objects.jsonl:2") as caught:
        listed(folder)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    str(caught.value).encode()


def test_a_catalogue_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "objects.jsonl").write_bytes(b'\xff\xfe{"uid": "a"}')
    with pytest.raises(TrilightError, match="UTF-8"):
        listed(tmp_path)


def test_builtin_objects_are_the_same_files_every_time(tmp_path: Path) -> None:
    first = list_objects("builtin:", work_dir=tmp_path / "one")
    assert len(first) == 64
    assert len({record.uid.split("-")[0] for record in first}) == 4
    second = list_objects("builtin:8", work_dir=tmp_path / "two")
    bytes_of = {record.uid: Path(record.path).read_bytes() for record in first}
    assert len(set(bytes_of.values())) == 64
    for record in second:
        assert Path(record.path).read_bytes() == bytes_of[record.uid]


def test_builtin_objects_are_mended_and_otherwise_left_alone(tmp_path: Path) -> None:
    records = list_objects("builtin:4", work_dir=tmp_path)
    paths = [Path(record.path) for record in records]
    whole = [path.read_bytes() for path in paths]
    paths[0].write_bytes(whole[0][:100])
    times = [path.stat().st_mtime_ns for path in paths]
    assert list_objects("builtin:4", work_dir=tmp_path) == records
    assert [path.read_bytes() for path in paths] == whole
    assert [path.stat().st_mtime_ns for path in paths[1:]] == times[1:]


@pytest.mark.parametrize(
    "source", ["builtin:0", "builtin:-3", "builtin:x", "builtin:1e3", "builtin:9999999999"]
)
def test_counts_without_meaning(tmp_path: Path, source: str) -> None:
    with pytest.raises(TrilightError, match=r"builtin:N with N from 1"):
        list_objects(source, work_dir=tmp_path)


def record(uid: str, licence: str) -> ObjectRecord:
    return ObjectRecord(uid=uid, path="", title="", licence=licence, attribution="", source_url="")


def test_the_default_refuses_what_is_unknown_or_restricted() -> None:
    allowed = ["CC0-1.0", "cc-by-4.0", "MIT", USER_PROVIDED]
    refused = ["LicenseRef-unknown", "CC-BY-NC-4.0", "CC-BY-ND-4.0", "CC-BY-NC-SA-4.0", "", "GPL"]
    records = [record(licence, licence) for licence in allowed + refused]
    kept, failures = refuse_licences(records, DEFAULT_ALLOWED)
    assert [one.uid for one in kept] == allowed
    assert [failure.item for failure in failures] == refused
    assert {(failure.stage, failure.reason) for failure in failures} == {
        ("objects", "licence_refused")
    }
    assert not any(mark in name for name in DEFAULT_ALLOWED for mark in ("NC", "ND", "unknown"))


def test_a_refusal_says_how_to_allow() -> None:
    one = record("a", "CC-BY-NC-4.0")
    _, (failure,) = refuse_licences([one], DEFAULT_ALLOWED)
    assert "--allow-licence 'CC-BY-NC-4.0'" in failure.message
    assert refuse_licences([one], (*DEFAULT_ALLOWED, "CC-BY-NC-4.0")) == ([one], [])


def test_real_objects_are_listed_and_five_refused(shared: Path, tmp_path: Path) -> None:
    records = list_objects(str(shared / "objects"), work_dir=tmp_path)
    kept, failures = refuse_licences(records, DEFAULT_ALLOWED)
    assert (len(records), len(kept), len(failures)) == (148, 143, 5)
