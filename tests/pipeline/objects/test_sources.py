"""Folders and built-in objects: what is found, under which names, and every mistake in a folder."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.assets.reading.source_file import SUFFIXES as READABLE
from pipeline.objects.generated import FAMILIES
from pipeline.objects.licences import DEFAULT_ALLOWED, USER_PROVIDED
from pipeline.objects.listing import SUFFIXES
from pipeline.objects.sources import FoundObjects, find_objects
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from storage.remote.safe_url import printable
from tests.for_each import for_each


def touch(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("v 0 0 0")


def find(source: Path | str, **options: Any) -> FoundObjects:
    options = {"allowed_licences": DEFAULT_ALLOWED, "work_dir": Path("unused"), **options}
    return find_objects(str(source), **options)


def listed(folder: Path) -> list[ObjectRecord]:
    found = find(folder)
    assert not found.failures
    return list(found.records)


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
    assert {record.licence_source for record in records} == {"assumed: the user's own files"}
    assert all(Path(record.path).is_absolute() for record in records)
    assert all(Path(record.path).read_text() == "v 0 0 0" for record in records)
    assert not Path("unused").exists()


def test_names_of_any_bytes_become_printable_uids(tmp_path: Path) -> None:
    for name in (b"line\nbreak.obj", b"latin-\xe9.obj", "größe.obj".encode()):
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)).write_text("v 0 0 0")
    records = listed(tmp_path)
    assert [record.uid for record in records] == ["größe", r"latin-\xe9", r"line\nbreak"]
    for record in records:
        json.dumps(vars(record) | {"path": ""}, ensure_ascii=False).encode()
        assert Path(record.path).read_text() == "v 0 0 0"


@for_each("text", ["plain", "größe", "a b", "日本"])
def test_printable_text_stays(text: str) -> None:
    assert printable(text) == text


def test_names_that_look_like_options_or_blanks(tmp_path: Path) -> None:
    touch(tmp_path, "-rf.obj", " .obj", "a .obj", "--/--.ply")
    uids = [record.uid for record in listed(tmp_path)]
    assert uids == [" .obj", "--/--", "-rf", "a "]


def test_files_that_differ_in_their_suffix_keep_it(tmp_path: Path) -> None:
    touch(tmp_path, "a.stl", "a.obj", "a.stl.obj", "a.OBJ", "b/a.ply", "b.gltf.glb", "b.glb")
    paths = {record.uid: Path(record.path).name for record in listed(tmp_path)}
    assert paths == {
        "a": "a.OBJ", "a.obj": "a.obj", "a.stl": "a.stl", "a.stl.obj": "a.stl.obj",
        "b": "b.glb", "b.gltf.glb": "b.gltf.glb", "b/a": "a.ply",
    }  # fmt: skip


def test_names_that_print_alike_cannot_both_stay(tmp_path: Path) -> None:
    touch(tmp_path, "a\nb.obj", r"a\nb.obj", r"a\nb.ply")
    found = find(tmp_path)
    names = {record.uid: Path(record.path).name for record in found.records}
    assert names == {r"a\nb": "a\nb.obj", r"a\nb.obj": r"a\nb.obj", r"a\nb.ply": r"a\nb.ply"}
    touch(tmp_path, "a\nb.ply")
    found = find(tmp_path)
    assert [(one.item, one.reason) for one in found.failures] == [(r"a\nb.ply", "name_clash")]
    assert Path(found.records[2].path).name == "a\nb.ply"


def test_copies_of_a_file_are_objects_of_their_own(tmp_path: Path) -> None:
    touch(tmp_path, "a.obj", "copy.obj")
    os.link(tmp_path / "a.obj", tmp_path / "hard.obj")
    (tmp_path / "soft.obj").symlink_to("a.obj")
    assert [record.uid for record in listed(tmp_path)] == ["a", "copy", "hard", "soft"]


def test_a_link_out_costs_itself_only(tmp_path: Path) -> None:
    folder = tmp_path / "objects"
    touch(folder, "a.obj", "d.obj")
    touch(tmp_path, "outside.obj", "more/x.obj")
    (folder / "b.obj").symlink_to(folder / "a.obj")
    (folder / "c.obj").symlink_to(tmp_path / "outside.obj")
    (folder / "e.obj").symlink_to("../outside.obj")
    (folder / "more").symlink_to(tmp_path / "more")
    (folder / "round.obj").symlink_to("round.obj")
    (folder / "gone.obj").symlink_to("nowhere.obj")
    found = find(folder)
    assert [record.uid for record in found.records] == ["a", "b", "d", "gone", "round"]
    assert [(one.item, one.reason) for one in found.failures] == [
        ("c", "link_outside"), ("e", "link_outside"),
    ]  # fmt: skip
    assert found.num_found == 7
    assert str(tmp_path) not in repr(found.failures)


def test_a_folder_that_is_itself_a_link(tmp_path: Path) -> None:
    touch(tmp_path / "real", "a.obj")
    (tmp_path / "link").symlink_to("real")
    assert [record.uid for record in listed(tmp_path / "link")] == ["a"]


def test_a_url_of_this_machine_is_its_folder(tmp_path: Path) -> None:
    touch(tmp_path / "my objects", "a.obj")
    assert find(f"file://{tmp_path}/my%20objects") == find(tmp_path / "my objects")


@for_each(
    "make, message",
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.write_text(""), "is not a folder"),
        (lambda path: path.mkdir(), "holds no object"),
        (lambda path: touch(path, "readme.txt", "sub/a.jpg"), "holds no object"),
        (lambda path: touch(path, "objects.jsonl"), "not JSON"),
    ],
)
def test_folders_without_objects(
    tmp_path: Path, make: Callable[[Path], object], message: str
) -> None:
    make(tmp_path / "objects")
    with pytest.raises(TrilightError, match=message) as caught:
        listed(tmp_path / "objects")
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_builtin_objects_are_the_same_files_every_time(tmp_path: Path) -> None:
    first = find("builtin:", work_dir=tmp_path / "one").records
    assert len(first) == 64
    assert len({record.uid.split("-")[0] for record in first}) == len(FAMILIES)
    second = find("builtin:8", work_dir=tmp_path / "two").records
    bytes_of = {record.uid: Path(record.path).read_bytes() for record in first}
    assert len(set(bytes_of.values())) == 64
    for record in second:
        assert Path(record.path).read_bytes() == bytes_of[record.uid]


def test_builtin_objects_are_mended_and_otherwise_left_alone(tmp_path: Path) -> None:
    records = find("builtin:4", work_dir=tmp_path).records
    paths = [Path(record.path) for record in records]
    whole = [path.read_bytes() for path in paths]
    paths[0].write_bytes(whole[0][:100])
    times = [path.stat().st_mtime_ns for path in paths]
    assert find("builtin:4", work_dir=tmp_path).records == records
    assert [path.read_bytes() for path in paths] == whole
    assert [path.stat().st_mtime_ns for path in paths[1:]] == times[1:]


@for_each("source", ["builtin:0", "builtin:-3", "builtin:x", "builtin:1e3", "builtin:9999999999"])
def test_counts_without_meaning(tmp_path: Path, source: str) -> None:
    with pytest.raises(TrilightError, match=r"builtin:N with N from 1"):
        find(source, work_dir=tmp_path)


def test_no_progress_where_nothing_is_downloaded(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    find("builtin:2", work_dir=tmp_path, downloaded=lambda *step: steps.append(step))
    assert steps == []


def test_real_objects_are_found_and_five_refused(shared: Path) -> None:
    found = find(shared / "objects")
    assert (len(found.records), len(found.failures), found.num_found) == (143, 5, 148)
    assert {failure.reason for failure in found.failures} == {"licence_refused"}
    assert [one.uid for one in found.records] == sorted(one.uid for one in found.records)
    assert [one.item for one in found.failures] == sorted(one.item for one in found.failures)
    assert {record.licence_source for record in found.records} == {"objects.jsonl"}
