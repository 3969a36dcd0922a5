"""Catalogues of both kinds: what a row says, and every mistake in one, by its line."""

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from tests.for_each import for_each
from tests.pipeline.objects.find_kit import find, touch

ALLOWED = ["CC0-1.0", "MIT", "LicenseRef-unknown"]


def write_catalogue(folder: Path, *rows: Any) -> None:
    lines = [row if isinstance(row, str) else json.dumps(row) for row in rows]
    (folder / "objects.jsonl").write_text("\n".join(lines) + "\n")


def write_csv(folder: Path, text: str, encoding: str = "utf-8") -> None:
    (folder / "objects.csv").write_text(text, encoding=encoding, newline="")


def listed(folder: Path, **options: Any) -> list[ObjectRecord]:
    found = find(folder, **{"allowed_licences": ALLOWED, **options})
    assert not found.failures
    return list(found.records)


def test_passwords_of_a_catalogue_are_not_published(tmp_path: Path) -> None:
    touch(tmp_path, "a.obj")
    url = "https://ada:s3cret@host/a?id=7"
    write_catalogue(
        tmp_path,
        {"uid": "a", "path": "a.obj", "licence": "MIT", "attribution": url, "source_url": url},
    )
    (record,) = listed(tmp_path)
    assert (record.source_url, record.attribution) == ("https://host/a?id=7",) * 2


def test_a_catalogue_rules_its_folder(tmp_path: Path) -> None:
    touch(tmp_path, "files/one.obj", "files/two.obj", "unlisted.obj")
    write_catalogue(
        tmp_path,
        {"uid": "two", "path": "files/two.obj", "licence": "CC0-1.0", "title": "Two\n\ud800"},
        "",
        {
            "uid": "one",
            "path": "files/one.obj",
            "attribution": "A",
            "source_url": "u",
            "x": 1,
            "licence_source": "letter of 2024-01-02",
        },
        {"uid": "gone", "path": "files/gone.obj", "licence": "MIT"},
    )
    gone, one, two = listed(tmp_path)
    assert (two.title, two.licence) == (r"Two\n\ud800", "CC0-1.0")
    assert (one.title, one.licence) == ("one", "LicenseRef-unknown")
    assert (one.attribution, one.source_url) == ("A", "u")
    assert (one.licence_source, two.licence_source) == ("letter of 2024-01-02", "objects.jsonl")
    assert Path(one.path) == tmp_path.resolve() / "files" / "one.obj"
    assert not Path(gone.path).exists()


GOOD = {"uid": "a", "path": "a.obj"}


@for_each(
    "row, message",
    [
        ("{not json", "objects.jsonl:2: not JSON"),
        ("[" * 100_000, "objects.jsonl:2: not JSON"),
        ([1, 2], "objects.jsonl:2: got a list"),
        ({"path": "a.obj"}, "objects.jsonl:2: field 'uid' is missing"),
        ({"uid": "b"}, "objects.jsonl:2: field 'path' is missing"),
        ({"uid": "b", "path": "a.obj", "licence": None}, "field 'licence' is a NoneType"),
        ({"uid": " ", "path": "a.obj"}, "not blank"),
        ({"uid": "b\n", "path": "a.obj"}, "printable"),
        ({"uid": "a", "path": "b.obj"}, "objects.jsonl:2: uid 'a' is already used in line 1"),
        ({"uid": "b", "path": ""}, "expected the name of a file"),
        ({"uid": "b", "path": "a\u0000b"}, "expected the name of a file"),
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


def test_a_catalogue_that_is_empty_or_no_text(tmp_path: Path) -> None:
    (tmp_path / "objects.jsonl").write_text("\n")
    with pytest.raises(TrilightError, match=r"holds no object.*objects\.jsonl"):
        listed(tmp_path)
    (tmp_path / "objects.jsonl").write_bytes(b'\xff\xfe{"uid": "a"}')
    with pytest.raises(TrilightError, match="UTF-8"):
        listed(tmp_path)
    (tmp_path / "objects.jsonl").unlink()
    (tmp_path / "objects.csv").write_bytes("uid,path\ngrö,a.obj".encode("latin-1"))
    with pytest.raises(TrilightError, match=r"objects\.csv: cannot be read.*UTF-8"):
        listed(tmp_path)


def test_one_file_may_be_two_objects(tmp_path: Path) -> None:
    touch(tmp_path, "a.obj")
    (tmp_path / "round.obj").symlink_to("round.obj")
    rows = [{"uid": uid, "path": "a.obj", "licence": "MIT"} for uid in ("x", "y")]
    write_catalogue(tmp_path, *rows, {"uid": "z", "path": "round.obj", "licence": "MIT"})
    x, y, _ = listed(tmp_path)
    assert x.path == y.path


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


@for_each(
    "text, message",
    [
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
    ],
)
def test_mistakes_in_a_table_are_placed(tmp_path: Path, text: str, message: str) -> None:
    write_csv(tmp_path, text)
    with pytest.raises(TrilightError, match=message) as caught:
        listed(tmp_path)
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_two_catalogues_in_one_folder(tmp_path: Path) -> None:
    write_catalogue(tmp_path, GOOD)
    write_csv(tmp_path, "uid,path\na,a.obj")
    with pytest.raises(TrilightError, match=r"objects\.jsonl and objects\.csv.*Remove one"):
        listed(tmp_path)
