"""Folders, catalogues, built-in objects, variables, licences: what is found, and every mistake."""

import itertools
import json
import logging
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.objects.file_filters import drop_duplicates, drop_outputs, drop_scenes, warn_once
from pipeline.objects.generated import FAMILIES
from pipeline.objects.licences import DEFAULT_ALLOWED, USER_PROVIDED, refuse_licences
from pipeline.objects.local.folder import list_folder
from pipeline.objects.maps.listing import find_maps
from storage.errors import TrilightError
from storage.records.objects import TEXTURE, ObjectRecord
from storage.remote import transfers
from tests.for_each import case, for_each, with_folders
from tests.pipeline.objects.conftest import find, reasons, refusal, touch
from tests.scenes_by_hand import tiny_scene
from trilight import write_scene

ALLOWED = ["CC0-1.0", "MIT", "LicenseRef-unknown", USER_PROVIDED]


def listed(folder: Path, **options: Any) -> list[ObjectRecord]:
    found = find(folder, **{"allowed_licences": ALLOWED, **options})
    assert not found.failures
    return list(found.records)


def test_a_folder_is_listed_at_any_depth_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "my objects"
    touch(folder, "b.OBJ", "a/z/deep.gltf.glb", "a/c.ply", "notes.txt", "a.bin", ".hidden.obj")
    touch(folder, "__pycache__/x.off", ".git/y.obj")
    records = listed(folder)
    assert [record.uid for record in records] == ["__pycache__/x", "a/c", "a/z/deep", "b"]
    assert [record.title for record in records] == ["x", "c", "deep", "b"]
    assert {record.licence for record in records} == {USER_PROVIDED}
    assert {record.licence_source for record in records} == {"assumed: the user's own files"}
    assert all(Path(record.path).is_absolute() for record in records)
    assert all(Path(record.path).read_text() == "v 0 0 0" for record in records)
    assert not Path("unused").exists()
    assert find(f"file://{tmp_path}/my%20objects") == find(folder)
    (tmp_path / "link").symlink_to("my objects")
    assert len(listed(tmp_path / "link")) == 4


def test_names_of_any_bytes_become_printable_uids(tmp_path: Path) -> None:
    for name in (b"line\nbreak.obj", b"latin-\xe9.obj", "größe.obj".encode()):
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)).write_text("v 0 0 0")
    touch(tmp_path, "-rf.obj", " .obj", "a .obj", "--/--.ply", "日本.obj")
    records = listed(tmp_path)
    assert [record.uid for record in records] == [
        " .obj", "--/--", "-rf", "a ", "größe", r"latin-\xe9", r"line\nbreak", "日本",
    ]  # fmt: skip
    for record in records:
        json.dumps(vars(record) | {"path": ""}, ensure_ascii=False).encode()
        assert Path(record.path).read_text() == "v 0 0 0"


def test_files_that_differ_in_their_suffix_are_objects_of_their_own_and_of_names_alike_one_stays(
    tmp_path: Path,
) -> None:
    """So are copies."""
    touch(tmp_path, "a.stl", "a.obj", "a.stl.obj", "a.OBJ", "b/a.ply", "b.gltf.glb", "b.glb")
    os.link(tmp_path / "a.obj", tmp_path / "hard.obj")
    (tmp_path / "soft.obj").symlink_to("a.obj")
    paths = {record.uid: Path(record.path).name for record in listed(tmp_path)}
    assert paths == {
        "a": "a.OBJ", "a.obj": "a.obj", "a.stl": "a.stl", "a.stl.obj": "a.stl.obj",
        "b": "b.glb", "b.gltf.glb": "b.gltf.glb", "b/a": "a.ply", "hard": "hard.obj",
        "soft": "soft.obj",
    }  # fmt: skip
    touch(tmp_path / "alike", "a\nb.obj", r"a\nb.obj", r"a\nb.ply", "a\nb.ply")
    found = find(tmp_path / "alike")
    names = {record.uid: Path(record.path).name for record in found.records}
    assert names == {r"a\nb": "a\nb.obj", r"a\nb.obj": r"a\nb.obj", r"a\nb.ply": "a\nb.ply"}
    assert reasons(found) == {r"a\nb.ply": "name_clash"}


def test_a_link_out_costs_itself_only(tmp_path: Path) -> None:
    folder = tmp_path / "objects"
    touch(folder, "a.obj", "d.obj")
    touch(tmp_path, "outside.obj", "more/x.obj")
    targets: dict[str, str | Path] = {
        "b.obj": folder / "a.obj", "c.obj": tmp_path / "outside.obj", "e.obj": "../outside.obj",
        "more": tmp_path / "more", "round.obj": "round.obj", "gone.obj": "nowhere.obj",
    }  # fmt: skip
    for name, target in targets.items():
        (folder / name).symlink_to(target)
    found = find(folder)
    assert [record.uid for record in found.records] == ["a", "b", "d", "gone", "round"]
    assert reasons(found) == {"c": "link_outside", "e": "link_outside"}
    assert str(tmp_path) not in repr(found.failures)


def test_folders_without_objects(tmp_path: Path) -> None:
    makes: list[tuple[Callable[[Path], object], str]] = [
        (lambda path: None, "does not exist.* procedural: for built-in objects"),
        (lambda path: path.write_text(""), "is not a folder"),
        (lambda path: path.mkdir(), "holds no object.* procedural: for built-in objects"),
        (lambda path: touch(path, "readme.txt", "sub/a.jpg"), "holds no object"),
        (lambda path: touch(path, "objects.jsonl"), "not JSON"),
    ]
    for folder, (make, message) in with_folders(tmp_path, makes):
        make(folder / "objects")
        refusal(folder / "objects", message)


def test_builtin_objects_are_the_same_files_every_time_and_are_mended(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    first = find("builtin:", work_dir=tmp_path / "one", downloaded=lambda *n: steps.append(n))
    assert steps == [], "nothing is downloaded"
    assert len({record.uid.split("-")[0] for record in first.records}) == len(FAMILIES)
    bytes_of = {record.uid: Path(record.path).read_bytes() for record in first.records}
    assert len(first.records) == len(set(bytes_of.values())) == 64
    second = find("builtin:8", work_dir=tmp_path / "two")
    paths = [Path(record.path) for record in second.records]
    whole = [bytes_of[record.uid] for record in second.records]
    assert [path.read_bytes() for path in paths] == whole
    paths[0].write_bytes(whole[0][:100])
    times = [path.stat().st_mtime_ns for path in paths]
    assert find("builtin:8", work_dir=tmp_path / "two") == second
    assert [path.read_bytes() for path in paths] == whole
    assert [path.stat().st_mtime_ns for path in paths[1:]] == times[1:]
    for count in ("0", "-3", "x", "1e3", "9999999999"):
        refusal(f"builtin:{count}", "builtin:N with N from 1", work_dir=tmp_path)


def test_real_objects_are_found_and_five_refused(shared: Path) -> None:
    found = find(shared / "objects")
    assert (len(found.records), len(found.failures)) == (143, 5)
    assert {failure.reason for failure in found.failures} == {"licence_refused"}
    assert [one.uid for one in found.records] == sorted(one.uid for one in found.records)
    assert [one.item for one in found.failures] == sorted(one.item for one in found.failures)
    assert {record.licence_source for record in found.records} == {"objects.jsonl"}


OUTPUTS = [
    "clean/assets.json clean/objects.jsonl clean/meshes/a-0123abcd.ply clean/quality.html",
    "clean/assets.json clean/meshes/a-0123abcd.ply",
    "in/d/manifest.json in/d/objects.lock.jsonl in/d/templates.png in/d/report/a.png",
    "d/manifest.json d/logs/asked.json d/contact_sheet.png",
    "objects/y/0_light_0_6.obj templates/backgrounds/y/4_box_4.obj",
    "run/settings.json run/metrics.jsonl run/validation_sheet.png",
    "coco/annotations/instances_test.json coco/test/000000003.0.png",
    "hf/train/metadata.jsonl hf/train/000000003.0.png hf/train/000000003.0.triangle.tiff",
]


@for_each("names", OUTPUTS)
def test_outputs_of_ours_are_left_out_with_a_note(
    names: str, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    mine = ["y.json", "chair.obj", "sub/table.ply", "sub/meshes/a.ply", "wood.png"]
    warn_once.cache_clear()
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert drop_outputs([*mine, *names.split()]) == mine
    folder = re.split("/(?:assets|manifest|settings|0_light|annotations|metadata)", names)[0]
    (said,) = caplog.messages
    assert said.startswith(f"left out as outputs of Trilight: {folder}")
    touch(tmp_path, *mine, *names.split())
    rows = list_folder(tmp_path, None).records
    assert [row.uid for row in rows] == ["chair", "sub/meshes/a", "sub/table"]
    found = find_maps(TEXTURE, str(tmp_path), licence=None, allowed_licences=DEFAULT_ALLOWED)
    assert ([one.record.uid for one in found[0]], found[1]) == (["texture:wood"], [])


def test_the_named_folder_may_be_an_output_scenes_of_ours_are_no_objects_and_others_are_named(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    names = [name.partition("/")[2] for name in OUTPUTS[0].split()]
    assert drop_outputs(names) == names
    (tmp_path / "ours.usda").write_bytes(b'#usda 1.0\n custom string trilight:sceneSha256 = "a"')
    (tmp_path / "ours.usdc").write_bytes(b"PXR-USDC" + bytes(1 << 15) + b"trilight:sceneSha256")
    write_scene(tiny_scene(), tmp_path / "ours.glb")
    (tmp_path / "theirs.usda").write_bytes(b"#usda 1.0\n")
    assert drop_scenes(tmp_path, sorted(p.name for p in tmp_path.iterdir())) == ["theirs.usda"]
    warn_once.cache_clear()
    touch(tmp_path / "b", "a.obj", "a.fbx", "b.fbx", "c.zip", "d.txt")
    assert [row.uid for row in list_folder(tmp_path / "b", None).records] == ["a"]
    assert "not read: b.fbx and 1 more" in caplog.messages[-1]


def test_an_object_of_a_collection_is_one_object() -> None:
    for names, kept in (
        ("m/raw_model.obj m/normalized_model.obj", "m/raw_model.obj"),  # 3D-FUTURE
        ("models/obj_01.ply models_eval/obj_01.ply", "models/obj_01.ply"),  # BOP
        ("models_eval/obj_01.ply", "models_eval/obj_01.ply"),
        ("mug/visual_geometry.obj mug/collision_geometry.obj", "mug/visual_geometry.obj"),  # GSO
        ("mug/meshes/model.obj", "mug/meshes/model.obj"),
        ("visual/a.obj collision/a.stl", "visual/a.obj"),  # robots
        ("collision/a.stl", "collision/a.stl"),
        ("c/google_16k/textured.obj c/google_16k/nontextured.ply c/poisson/textured.obj",
         "c/google_16k/textured.obj"),  # YCB
        ("rock_LOD0.obj rock_LOD1.obj rock_LOD2.obj tree_LOD3.obj", "rock_LOD0.obj tree_LOD3.obj"),
        ("a.obj a.stl UCX_a.obj a_coll_01.obj", "a.obj a.stl"),
        ("02958343/1a/models/model_normalized.obj", "02958343/1a/models/model_normalized.obj"),
    ):  # fmt: skip
        assert " ".join(drop_duplicates(names.split())) == kept


def write_catalogue(folder: Path, *rows: Any) -> None:
    lines = [row if isinstance(row, str) else json.dumps(row) for row in rows]
    (folder / "objects.jsonl").write_text("\n".join(lines) + "\n")


def write_csv(folder: Path, text: str, encoding: str = "utf-8") -> None:
    (folder / "objects.csv").write_text(text, encoding=encoding, newline="")


def test_a_catalogue_rules_its_folder_and_publishes_no_password(tmp_path: Path) -> None:
    touch(tmp_path, "files/one.obj", "files/two.obj", "unlisted.obj")
    (tmp_path / "round.obj").symlink_to("round.obj")
    url = "https://ada:s3cret@host/a?id=7"
    write_catalogue(
        tmp_path,
        {"uid": "two", "path": "files/two.obj", "licence": "CC0-1.0", "title": "Two\n\ud800"},
        "",
        {"uid": "one", "path": "files/one.obj", "attribution": url, "source_url": url, "x": 1,
         "licence_source": "letter of 2024-01-02"},
        {"uid": "gone", "path": "files/gone.obj", "licence": "MIT"},
        {"uid": "again", "path": "files/one.obj", "licence": "MIT"},
        {"uid": "round", "path": "round.obj", "licence": "MIT"},
    )  # fmt: skip
    again, gone, one, _, two = listed(tmp_path)
    assert (two.title, two.licence) == (r"Two\n\ud800", "CC0-1.0")
    assert (one.title, one.licence) == ("one", "LicenseRef-unknown")
    assert (one.attribution, one.source_url) == ("https://host/a?id=7",) * 2
    assert (one.licence_source, two.licence_source) == ("letter of 2024-01-02", "objects.jsonl")
    assert Path(one.path) == tmp_path.resolve() / "files" / "one.obj"
    assert again.path == one.path
    assert not Path(gone.path).exists()


ROWS: list[tuple[Any, str]] = [
    ("{not json", "not JSON"),
    ("[" * 100_000, "not JSON"),
    ([1, 2], "got a list"),
    ({"path": "a.obj"}, "field 'uid' is missing"),
    ({"uid": "b"}, "field 'path' is missing"),
    ({"uid": "b", "path": "a.obj", "licence": None}, "field 'licence' is a NoneType"),
    ({"uid": " ", "path": "a.obj"}, "not blank"),
    ({"uid": "b\n", "path": "a.obj"}, "printable"),
    ({"uid": "a", "path": "b.obj"}, "uid 'a' is already used in line 1"),
    ({"uid": "b", "path": ""}, "expected the name of a file"),
    ({"uid": "b", "path": "a\u0000b"}, "expected the name of a file"),
    ({"uid": "b", "path": "x/../../secret.obj"}, "leads out"),
    ({"uid": "b", "path": "/etc/hostname"}, "leads out"),
    ({"uid": "b", "path": "link.obj"}, "leads out"),
]
"""Second rows of a catalogue, after a good one."""


def test_catalogues_that_are_empty_no_text_or_two(tmp_path: Path) -> None:
    lines, table = tmp_path / "objects.jsonl", tmp_path / "objects.csv"
    for path, data, message in (
        (lines, b"\n", r"holds no object.*objects\.jsonl"),
        (lines, b'\xff\xfe{"uid": "a"}', "UTF-8"),
        (table, "uid,path\ngrö,a.obj".encode("latin-1"), r"objects\.jsonl and .*csv.*Remove one"),
    ):
        path.write_bytes(data)
        refusal(tmp_path, message)
    lines.unlink()
    refusal(tmp_path, r"objects\.csv: cannot be read.*UTF-8")


TABLE = """uid , path,title,licence,licence_source,attribution,source_url,more
two,files/two.obj,"Two, ""the"" chair",CC0-1.0,,,https://x,
"one","a
b.obj",,MIT, letter,Ada,,x

,,,,,,,
grö,c.obj, ,  ,,,,
"""


@for_each("encoding, ending", itertools.product(["utf-8", "utf-8-sig"], ["\n", "\r\n"]))
def test_a_table_says_what_lines_say(tmp_path: Path, encoding: str, ending: str) -> None:
    write_csv(tmp_path, TABLE.replace("\n", ending), encoding)
    groe, one, two = sorted(listed(tmp_path), key=lambda record: record.uid)
    assert (two.title, two.licence, two.licence_source) == (
        'Two, "the" chair', "CC0-1.0", "objects.csv",
    )  # fmt: skip
    assert (two.attribution, two.source_url) == ("", "https://x")
    assert (one.title, one.licence, one.licence_source) == ("one", "MIT", " letter")
    assert one.path == str(tmp_path / f"a{ending}b.obj")
    assert (groe.uid, groe.title, groe.licence) == ("grö", "grö", "LicenseRef-unknown")


TABLES = [
    ("uid;path\na;b", "objects.csv:1: the columns are 'uid;path'; expected uid and path"),
    ("uid,path,path\na,b,c", "objects.csv:1: .*each name once"),
    ("uid,path\na", "objects.csv:2: has 1 cells; expected 2"),
    ('uid,path\n"a\n\nb",c.obj\nd', "objects.csv:2: uid is"),
    ('uid,path,title\na,c.obj,"x\n\ny"\nd', "objects.csv:5: has 1 cells"),
    ('uid,path\na,"b" c', "objects.csv:2: not CSV"),
    ('uid,path\na,b\nc,"d', "objects.csv:3: not CSV"),
    ("uid,path\na," + "x" * 200_000, "objects.csv:2: not CSV"),
    ("uid,path\na,b.obj\na,c.obj", "objects.csv:3: uid 'a' is already used in line 2"),
    ("uid,path\n,b.obj", "objects.csv:2: field 'uid' is missing"),
    ("uid,path\na, ", "objects.csv:2: field 'path' is missing"),
    ("uid,path\na,b\x00c", "objects.csv:2: path is"),
    ("uid,path\n", "holds no object"),
]


def test_mistakes_in_a_catalogue_are_placed(tmp_path: Path) -> None:
    touch(tmp_path, "secret.obj")
    mistakes: list[tuple[str, Any, str]] = [
        ("objects.jsonl", row, f"objects.jsonl:2: .*{message}") for row, message in ROWS
    ]
    mistakes += [("objects.csv", *entry) for entry in TABLES]
    for folder, (name, text, message) in with_folders(tmp_path, mistakes):
        touch(folder, "a.obj")
        (folder / "link.obj").symlink_to(tmp_path / "secret.obj")
        if name == "objects.csv":
            write_csv(folder, text)
        else:
            write_catalogue(folder, {"uid": "a", "path": "a.obj"}, text)
        assert refusal(folder, message).encode()


CANARY = "hunter2-secret-value"
VARIABLE = "env:TRILIGHT_SOURCE_MINE"


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


def test_only_variables_of_sources_are_read_and_no_message_shows_what_they_say(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("PATH", "AWS_SECRET_ACCESS_KEY", "TRILIGHT_CACHE", "", "A\nB"):
        if name.isidentifier():
            monkeypatch.setenv(name, CANARY)
        assert CANARY not in refusal(f"env:{name}", "begins with TRILIGHT_SOURCE_")
    touch(tmp_path, "a.obj")
    monkeypatch.setenv("TRILIGHT_SOURCE_MINE", str(tmp_path))
    assert [record.uid for record in find(VARIABLE).records] == ["a"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(transfers, "PAUSE_S", 0.0)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    for value in VALUES:
        monkeypatch.setenv("TRILIGHT_SOURCE_MINE", value)
        with pytest.raises(TrilightError) as caught:
            find(VARIABLE)
        message = str(caught.value)
        assert VARIABLE in message, value
        assert "does not exist" in message or value != CANARY
        for part in ("hunter2", "127.0.0.1", "bucket", "quoted"):
            assert part not in message, value
        assert caught.value.__cause__ is None and caught.value.__suppress_context__, value
    (tmp_path / CANARY).mkdir()
    monkeypatch.setenv("TRILIGHT_SOURCE_MINE", str(tmp_path / CANARY))
    assert CANARY not in refusal(VARIABLE, f"^objects '{VARIABLE}'")


def record(licence: str) -> ObjectRecord:
    silent = dict.fromkeys(("path", "title", "licence_source", "attribution", "source_url"), "")
    return ObjectRecord(uid=licence, licence=licence, **silent)


def test_the_default_refuses_what_is_unknown_or_restricted() -> None:
    allowed = ["CC0-1.0", "cc-by-4.0", "MIT", USER_PROVIDED]
    refused = ["LicenseRef-unknown", "CC-BY-NC-4.0", "CC-BY-ND-4.0", "CC-BY-NC-SA-4.0", "", "GPL"]
    records = [record(licence) for licence in allowed + refused]
    kept, failures = refuse_licences(records, DEFAULT_ALLOWED)
    assert [one.uid for one in kept] == allowed
    assert [failure.item for failure in failures] == refused
    assert {failure.stage for failure in failures} == {"objects"}
    assert {failure.reason for failure in failures} == {"licence_refused"}
    assert not any(mark in name for name in DEFAULT_ALLOWED for mark in ("NC", "ND", "unknown"))
    # A refusal says how to allow what an allow list can name.
    for licence in ("CC-BY-NC-4.0", "MIT OR Apache-2.0"):
        _, (failure,) = refuse_licences([record(licence)], DEFAULT_ALLOWED)
        assert f"--allow-licence '{licence}'" in failure.message
        assert refuse_licences([record(licence)], [licence.lower()])[1] == []
    for licence in ("", "CC BY 4.0", "x" * 65, "Größe"):
        _, (failure,) = refuse_licences([record(licence)], DEFAULT_ALLOWED)
        assert "--allow-licence" not in failure.message
        assert "expected an SPDX identifier" in failure.message


def test_a_stated_licence_is_that_of_silent_files_and_not_of_sources_that_state_their_own(
    tmp_path: Path,
) -> None:
    touch(tmp_path, "a.obj")
    (one,) = find(tmp_path, allowed_licences=["CC-BY-4.0"], licence="cc-by-4.0").records
    assert (one.licence, one.licence_source) == ("cc-by-4.0", "stated by the user (--licence)")
    found = find(tmp_path, licence="CC-BY-NC-4.0")
    assert not found.records and reasons(found) == {"a": "licence_refused"}
    for licence in ("MIT", "CC-BY-SA-4.0", "GPL-2.0+", "LicenseRef-My.Shop-1", "x" * 64):
        (one,) = find(tmp_path, allowed_licences=[licence], licence=licence).records
        assert one.licence == licence
    for bad in ("", " ", "CC BY", "CC-BY-4.0\n", "a/b", "x" * 65, "LicenseRef-größe", "a:b"):
        for options in ({"licence": bad}, {"allowed_licences": [bad]}):
            with case(options):
                refusal(tmp_path, "expected an SPDX identifier", **options)
    for folder, name in with_folders(tmp_path, ("objects.jsonl", "objects.csv")):
        touch(folder, name)
        refusal(folder, f"--licence is 'MIT', but {name} states", work_dir=folder, licence="MIT")
    for name in ("builtin:", "objaverse:"):
        refusal(name, f"--licence is 'MIT', but {name} states", work_dir=tmp_path, licence="MIT")
