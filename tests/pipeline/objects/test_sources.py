"""Folders, built-in objects, variables, licences: what is found, and every mistake in one."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.foreign.source_file import SUFFIXES as READABLE
from pipeline.objects.generated import FAMILIES
from pipeline.objects.licences import DEFAULT_ALLOWED, USER_PROVIDED, refuse_licences
from pipeline.objects.listing import SUFFIXES
from pipeline.objects.sources import find_objects
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from storage.remote import tries
from tests.for_each import for_each
from tests.pipeline.objects.find_kit import find, touch


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


def test_names_that_look_like_options_or_blanks(tmp_path: Path) -> None:
    touch(tmp_path, "-rf.obj", " .obj", "a .obj", "--/--.ply", "日本.obj")
    uids = [record.uid for record in listed(tmp_path)]
    assert uids == [" .obj", "--/--", "-rf", "a ", "日本"]


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
    steps: list[tuple[int, int]] = []
    first = find(
        "builtin:", work_dir=tmp_path / "one", downloaded=lambda *step: steps.append(step)
    ).records
    assert steps == [], "nothing is downloaded"
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


def test_real_objects_are_found_and_five_refused(shared: Path) -> None:
    found = find(shared / "objects")
    assert (len(found.records), len(found.failures), found.num_found) == (143, 5, 148)
    assert {failure.reason for failure in found.failures} == {"licence_refused"}
    assert [one.uid for one in found.records] == sorted(one.uid for one in found.records)
    assert [one.item for one in found.failures] == sorted(one.item for one in found.failures)
    assert {record.licence_source for record in found.records} == {"objects.jsonl"}


CANARY = "hunter2-secret-value"


@pytest.mark.parametrize("name", ["PATH", "AWS_SECRET_ACCESS_KEY", "TRILIGHT_CACHE", "", "A\nB"])
def test_only_variables_of_sources_are_read(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    if name.isidentifier():
        monkeypatch.setenv(name, CANARY)
    with pytest.raises(TrilightError, match="begins with TRILIGHT_SOURCE_") as caught:
        find(f"env:{name}")
    assert CANARY not in str(caught.value)


def test_the_source_that_it_says_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0")
    monkeypatch.setenv("TRILIGHT_SOURCE_MINE", str(tmp_path))
    assert [record.uid for record in find("env:TRILIGHT_SOURCE_MINE").records] == ["a"]


VALUES = (
    CANARY,
    f"/no/{CANARY}'quoted\nand more",
    f"https://me:{CANARY}@127.0.0.1:9/{CANARY}?key={CANARY}",
    f"ftp://{CANARY}/x",
    f"s3://me:{CANARY}@bucket/x",
    f"pipe:cat {CANARY}",
    f"builtin:{CANARY}",
    f"objaverse:{CANARY}",
)


def test_no_message_shows_what_it_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tries, "PAUSE_S", 0.0)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    for value in VALUES:
        monkeypatch.setenv("TRILIGHT_SOURCE_MINE", value)
        with pytest.raises(TrilightError) as caught:
            find("env:TRILIGHT_SOURCE_MINE")
        message = str(caught.value)
        assert "env:TRILIGHT_SOURCE_MINE" in message, value
        assert "does not exist" in message or value != CANARY
        for part in ("hunter2", "127.0.0.1", "bucket", "quoted"):
            assert part not in message, value
        assert caught.value.__cause__ is None and caught.value.__suppress_context__, value
    (tmp_path / CANARY).mkdir()
    monkeypatch.setenv("TRILIGHT_SOURCE_MINE", str(tmp_path / CANARY))
    with pytest.raises(TrilightError, match="^objects 'env:TRILIGHT_SOURCE_MINE'") as caught:
        find("env:TRILIGHT_SOURCE_MINE")
    assert CANARY not in str(caught.value)


def record(uid: str, licence: str) -> ObjectRecord:
    silent = dict.fromkeys(("path", "title", "licence_source", "attribution", "source_url"), "")
    return ObjectRecord(uid=uid, licence=licence, **silent)


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
    for licence in ("CC-BY-NC-4.0", "MIT OR Apache-2.0"):
        one = record("a", licence)
        _, (failure,) = refuse_licences([one], DEFAULT_ALLOWED)
        assert f"--allow-licence '{licence}'" in failure.message
        assert refuse_licences([one], [licence.lower()]) == ([one], [])


@for_each("licence", ["", "CC BY 4.0", "x" * 65, "Größe"])
def test_what_is_no_identifier_is_to_be_mended(licence: str) -> None:
    """No allow-list can name it, so the message must not say so."""
    _, (failure,) = refuse_licences([record("a", licence)], DEFAULT_ALLOWED)
    assert "--allow-licence" not in failure.message
    assert "expected an SPDX identifier" in failure.message


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.obj").write_text("v 0 0 0")
    return tmp_path


def test_a_stated_licence_is_that_of_silent_files(folder: Path) -> None:
    found = find_objects(
        str(folder), work_dir=folder, allowed_licences=["CC-BY-4.0"], licence="cc-by-4.0"
    )
    (one,) = found.records
    assert (one.licence, one.licence_source) == ("cc-by-4.0", "stated by the user (--licence)")
    found = find(folder, licence="CC-BY-NC-4.0")
    assert not found.records
    assert [failure.reason for failure in found.failures] == ["licence_refused"]


@pytest.mark.parametrize("name", ["objects.jsonl", "objects.csv", "builtin:", "objaverse:"])
def test_sources_that_state_their_own(folder: Path, name: str) -> None:
    source = name if name.endswith(":") else str(folder)
    if source != name:
        (folder / name).write_text("")
    with pytest.raises(TrilightError, match=f"--licence is 'MIT', but {name} states"):
        find_objects(source, work_dir=folder, allowed_licences=["MIT"], licence="MIT")


BAD = ["", " ", "CC BY", "CC-BY-4.0\n", "a/b", "x" * 65, "LicenseRef-größe", "a:b", "(MIT)"]


def test_malformed_identifiers(folder: Path) -> None:
    stated: list[dict[str, Any]] = [{"allowed_licences": ["MIT"], "licence": one} for one in BAD]
    for options in (*stated, *({"allowed_licences": [one]} for one in BAD)):
        with pytest.raises(TrilightError, match="expected an SPDX identifier") as caught:
            find_objects(str(folder), work_dir=folder, **options)
        assert "\n" not in str(caught.value), options


@pytest.mark.parametrize(
    "licence", ["MIT", "CC-BY-SA-4.0", "GPL-2.0+", "LicenseRef-My.Shop-1", "x" * 64]
)
def test_well_formed_identifiers(folder: Path, licence: str) -> None:
    (one,) = find_objects(
        str(folder), work_dir=folder, allowed_licences=[licence], licence=licence
    ).records
    assert one.licence == licence
