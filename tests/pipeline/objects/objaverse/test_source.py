"""Objaverse: which objects, with which rights; mistakes; broken links."""

import dataclasses
import gzip
import hashlib
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.objects.listing import Listing
from pipeline.objects.objaverse import source as objaverse
from tests.for_each import case, for_each
from tests.http_server import Fault, Site
from tests.pipeline.objects import conftest

pytestmark = pytest.mark.usefixtures("place")


NAMES = ("a", "b", "c", "d", "paid", "mute")
UID = {name: hashlib.md5(name.encode(), usedforsecurity=False).hexdigest() for name in NAMES}
NAME = {uid: name for name, uid in UID.items()}
IN_ORDER = [NAME[uid] for uid in sorted(NAME)]
FREE = [name for name in IN_ORDER if name not in ("paid", "mute")]


def glb(name: str) -> str:
    return f"/glbs/000-00{NAMES.index(name) % 3}/{UID[name]}.glb"


def annotation(name: str) -> dict[str, Any]:
    return {
        "uid": UID[name],
        "name": f"The {name}\n",
        "license": {"paid": "by-nc", "b": "by-sa", "c": "cc0"}.get(name, "by"),
        "user": {"displayName": "Ada", "username": "ada1", "profileUrl": "https://p/ada"},
        "viewerUrl": f"https://v/{name}",
        "publishedAt": "2019-05-03T01:02:03.456",
    }


def packed(value: object) -> bytes:
    return gzip.compress(json.dumps(value).encode())


def find(text: str, **options: Any) -> Listing:
    return conftest.find(f"objaverse:{text}", **options)


def found_names(found: Listing) -> list[str]:
    return [NAME[record.uid.removeprefix("objaverse/")] for record in found.records]


def reasons(found: Listing) -> dict[str, str]:
    rows = conftest.reasons(found).items()
    return {NAME.get(item.removeprefix("objaverse/"), item): reason for item, reason in rows}


@pytest.fixture
def place(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Serve metadata and objects of a small Objaverse; returns where its files are kept."""
    site.files["/object-paths.json.gz"] = packed({UID[name]: glb(name)[1:] for name in NAMES})
    for number in range(3):
        rows = {UID[name]: annotation(name) for name in NAMES if NAMES.index(name) % 3 == number}
        rows.pop(UID["mute"], None)
        site.files[f"/metadata/000-00{number}.json.gz"] = packed(rows)
    site.files["/lvis-annotations.json.gz"] = packed(
        {"chair": [UID[name] for name in ("d", "paid", "a", "mute")], "sofa_bed": [UID["b"]],
         "vase": [UID["c"], UID["a"]]}
    )  # fmt: skip
    for name in NAMES:
        site.files[glb(name)] = f"glTF {name}".encode()
    url = dataclasses.replace(objaverse._URL, scheme="http", root=site.url)
    monkeypatch.setattr(objaverse, "_URL", url)
    folder = tmp_path / "hf-objaverse-v1"
    monkeypatch.setattr(objaverse, "_FOLDER", folder)
    return folder


def test_uids_come_with_their_rights(site: Site) -> None:
    found = find(f"{UID['a'].upper()} ,{UID['b']},{UID['c']},{UID['a']}")
    by_name = dict(zip(found_names(found), found.records, strict=True))
    assert found_names(found) == [name for name in IN_ORDER if name in "abc"]
    a = by_name["a"]
    assert (a.uid, a.title) == (f"objaverse/{UID['a']}", r"The a\n")
    assert (a.licence, a.attribution) == ("CC-BY-4.0", r"The a\n by Ada (https://p/ada)")
    assert a.licence_source == "Objaverse 1.0 annotations; object published 2019-05-03"
    assert a.source_url == "https://v/a"
    assert Path(a.path).read_text() == "glTF a"
    assert (by_name["b"].licence, by_name["c"].licence) == ("CC-BY-SA-4.0", "CC0-1.0")
    assert found.failures == []
    site.requests.clear()
    assert find(f"{UID['a']},{UID['b']},{UID['c']}") == found
    assert site.requests == []


def test_a_file_of_uids_and_mistakes(tmp_path: Path) -> None:
    path = tmp_path / "uids.txt"
    path.write_text(f"# mine\n\n{UID['a']}  # good\r\n  {UID['d']}\n")
    assert found_names(find(str(path))) == [name for name in IN_ORDER if name in "ad"]
    for content, message in (
        (f"{UID['a']}\nchair\n".encode(), r"uids\.txt:2: got 'chair'"),
        (f"{UID['a']} {UID['b']}".encode(), r"uids\.txt:1"),
        (b"# nothing\n", "holds no uid"),
        (b"\xff\xfe", "UTF-8"),
    ):
        path.write_bytes(content)
        conftest.refusal(f"objaverse:{path}", message)
    for text, message in (
        ("", "names no file and no uid"),
        ("category/", "malformed"),
        ("category/chair:0", "malformed"),
        ("category/chair,,vase", "malformed"),
        ("category/chairs", "no such category.*3 LVIS categories.*Did you mean chair"),
        ("category/sofabed", "Did you mean sofa_bed"),
    ):
        with case(text):
            conftest.refusal(f"objaverse:{text}", message)


@for_each("count", [1, 2, 3, 99])
def test_the_first_n_of_a_category_are_the_first_allowed(site: Site, count: int) -> None:
    members = [name for name in IN_ORDER if name in ("a", "d", "b", "paid", "mute")]
    chosen = [name for name in members if name in FREE][:count]
    site.requests.clear()
    found = find(f"category/chair,sofa_bed:{count}")
    assert found_names(found) == chosen
    passed_over = members if count == 99 else members[: members.index(chosen[-1])]
    assert set(reasons(found)) == set(passed_over) - set(FREE)
    new = {path for path in site.gets() if path.startswith("/glbs")}
    assert new <= {glb(name) for name in chosen}


def test_refused_licences_are_not_asked_for(site: Site) -> None:
    steps: list[tuple[int, int]] = []
    found = find("category/chair", downloaded=lambda *step: steps.append(step))
    assert steps == [(0, 2), (1, 2), (2, 2)]
    assert reasons(found) == {"paid": "licence_refused", "mute": "licence_refused"}
    assert "CC-BY-NC-4.0" in " ".join(one.message for one in found.failures)
    assert "LicenseRef-unknown" in " ".join(one.message for one in found.failures)
    assert not {glb("paid"), glb("mute")} & set(site.gets())
    allowed = find("category/chair", allowed_licences=["CC-BY-NC-4.0"])
    assert found_names(allowed) == ["paid"]


def test_annotations_that_say_little(site: Site) -> None:
    odd = {UID["a"]: {"license": 7, "user": None, "name": None, "publishedAt": "soon"}}
    site.files["/metadata/000-000.json.gz"] = packed(odd)
    (one,) = find(UID["a"], allowed_licences=["LicenseRef-unknown"]).records
    assert (one.title, one.source_url) == (UID["a"], "")
    assert one.attribution == f"{UID['a']} by an unknown author"
    assert one.licence_source.endswith("of unknown date")


def test_unknown_uids_and_paths_that_lead_out_cost_themselves_only(site: Site) -> None:
    paths = {UID["a"]: "../../glbs/x.glb", UID["b"]: glb("b")[1:], UID["c"]: "/etc/x.glb"}
    site.files["/object-paths.json.gz"] = packed(paths)
    found = find(f"{UID['a']},{UID['b']},{UID['c']},{'0' * 32}")
    assert found_names(found) == ["b"]
    assert reasons(found) == dict.fromkeys(("a", "c", f"objaverse/{'0' * 32}"), "unknown_uid")


@for_each("status, message", [(404, "no such file"), (500, "status 500")])
def test_a_dead_link_costs_one_object(site: Site, place: Path, status: int, message: str) -> None:
    site.always = {glb("d"): Fault(status=status)}
    found = find("category/chair,vase")
    assert found_names(found) == [name for name in FREE if name in "ac"]
    assert reasons(found)["d"] == "download_failed"
    assert message in " ".join(one.message for one in found.failures)
    site.always.clear()
    site.requests.clear()
    assert "d" in found_names(find("category/chair,vase"))
    assert list(site.gets()) == [glb("d")]
    (place / glb("d")[1:]).unlink()


def test_damaged_metadata_is_fetched_again(site: Site, place: Path) -> None:
    whole = find("category/vase,chair")
    damages: list[Callable[[bytes], bytes]] = [
        lambda data: data[:40],
        lambda data: b"<html>",
        lambda data: gzip.compress(b"{"),
        lambda data: data[:-9] + bytes(9),
    ]
    names = ("object-paths.json.gz", "lvis-annotations.json.gz", "metadata/000-000.json.gz")
    for name, damage in itertools.product(names, damages):
        (place / name).write_bytes(damage((place / name).read_bytes()))
        site.requests.clear()
        assert find("category/vase,chair") == whole
        assert dict(site.gets()) == {f"/{name}": 1}


def test_a_transfer_that_breaks_leaves_nothing_broken(site: Site) -> None:
    site.always = {"/metadata/000-000.json.gz": Fault(cut_after=30), glb("b"): Fault(cut_after=3)}
    found = find(f"{UID['a']},{UID['b']},{UID['c']}")
    assert found_names(found) == ["c"]
    assert reasons(found) == {"a": "download_failed", "b": "download_failed"}
    site.always.clear()
    assert set(found_names(find(f"{UID['a']},{UID['b']},{UID['c']}"))) == {"a", "b", "c"}


def test_no_server_at_all(site: Site) -> None:
    site.always = {"/object-paths.json.gz": Fault(status=503)}
    source = f"objaverse:{UID['a']}"
    conftest.refusal(source, r"object-paths\.json\.gz cannot be downloaded .*503")
    site.always = {glb("a"): Fault(status=503)}
    conftest.refusal(source, "none of 1 objects could be downloaded.*503")
