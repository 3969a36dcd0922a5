"""Folders on servers: which URLs name them, what is asked for, what is not, and what breaks."""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.objects.licences import DEFAULT_ALLOWED, USER_PROVIDED
from pipeline.objects.remote import source as remote_source
from pipeline.objects.sources import list_objects
from storage.errors import TrilightError
from storage.remote import url as remote_url
from storage.remote.url import PACKAGES, RemoteUrl, open_driver, parse_url
from tests.for_each import case
from tests.http_server import Fault, Site, serve
from tests.pipeline.objects.conftest import find, reasons, refusal

pytest.importorskip("aiohttp", reason="http needs the package aiohttp")


def remote(source: str) -> RemoteUrl:
    url = parse_url(source, what="objects")
    assert isinstance(url, RemoteUrl)
    return url


def test_folders_of_this_machine_and_of_servers() -> None:
    for source, path in (
        ("objects", "objects"),
        ("/a/b c", "/a/b c"),
        ("file:///a/b%20c", "/a/b c"),
        ("file://localhost/a", "/a"),
        ("FILE:///a", "/a"),
        ("C:x", "C:x"),
        ("a::b", "a::b"),
    ):
        assert parse_url(source, what="objects") == Path(path), source
    for source, scheme, root in (
        ("https://host/a/b/", "https", "https://host/a/b"),
        ("HTTP://host", "http", "http://host"),
        ("http://host/a b/ä%20", "http", "http://host/a%20b/%C3%A4%20"),
        ("http://ada:s3@cret@host:1/a?k=1&l#m", "http", "http://host:1/a"),
        ("http://[::1]:8000/a", "http", "http://[::1]:8000/a"),
        ("http://ada:x@[fe80::1]/a", "http", "http://[fe80::1]/a"),
        ("s3://bucket/a b/?#/", "s3", "bucket/a b/?#"),
        ("gs://bucket", "gs", "bucket"),
        ("hf://datasets/ada/set@main/a", "hf", "datasets/ada/set@main/a"),
    ):
        url = remote(source)
        assert (url.scheme, url.root) == (scheme, root)
        assert "cret" not in repr(url) and "cret" not in url.display_url


def test_credentials_are_kept_apart_and_a_missing_driver_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url = remote("http://a%40da:s3@cret@host/x?k=1&l=&k=2#m")
    assert (url.user, url.password) == ("a@da", "s3@cret")
    assert url.query == (("k", "1"), ("l", ""), ("k", "2"))
    for scheme, package in PACKAGES.items():
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(TrilightError, match=f"pip install {package}"):
            open_driver(remote(f"{scheme}://host/a"))


def test_other_urls_are_refused(tmp_path: Path) -> None:
    for source, message in (
        ("pipe:cat x", "pipe: command"),
        ("pipe://cat x", "pipe: command"),
        ("simplecache::http://ada:s3cret@host/a", "chained"),
        ("http://host/a::file://b", "chained"),
        ("http://[::1]/::b", "chained"),
        ("ftp://ada:s3cret@host/a?s3cret", "'ftp'"),
        ("memory://a", "'memory'"),
        ("http://", "no host"),
        ("s3://", "no host or bucket"),
        ("s3://ada:s3cret@bucket/a", "came with a user"),
        ("file://host/a", "three slashes"),
        ("file://", "three slashes"),
    ):
        with case(source):
            text = refusal(source, message, work_dir=tmp_path)
        assert "s3cret" not in text and "ada" not in text


class _Bucket:
    """What s3fs, gcsfs and huggingface_hub have in common, over a dictionary."""

    async_impl = False
    is_listed = False

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files = files
        self.fetched: list[str] = []
        self.listed: list[str] = []

    def info(self, address: str) -> dict[str, Any]:
        if not self.is_listed:
            self.is_listed = True
            self.listed.append(address)
        if any(name.startswith(f"{address}/") for name in self.files):
            return {"name": address, "type": "directory", "size": 0}
        if address not in self.files:
            raise FileNotFoundError(address)
        data = self.files[address]
        return {"name": address, "type": "file", "size": len(data), "ETag": hash(data)}

    def find(self, root: str, *, detail: bool) -> dict[str, dict[str, Any]]:
        return {name: self.info(name) for name in self.files if name.startswith(root)}

    def cat_file(self, address: str, *, start: int, end: int) -> bytes:
        self.fetched.append(address)
        return self.files[address][start:end]

    def invalidate_cache(self) -> None:
        self.is_listed = False


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> _Bucket:
    """The bucket that any address leads to."""
    made = _Bucket({f"bucket/{name}.obj": name.encode() for name in "abc"})
    for user in ("pipeline.objects.remote.source", "storage.remote.transfers"):
        monkeypatch.setattr(f"{user}.shared_driver", lambda url: made)
    return made


def test_a_bucket_is_listed_at_once_and_what_is_not_wanted_stays_there(
    bucket: _Bucket, cache: Path
) -> None:
    listed = list_objects("s3://bucket", work_dir=cache, allowed_licences=DEFAULT_ALLOWED)
    assert bucket.fetched == []
    found = listed.fetch_selected(lambda uid: uid == "b")
    assert [record.uid for record in found.records] == ["b"]
    assert bucket.fetched == ["bucket/b.obj"]
    assert len(listed.records) + len(listed.failures) == 3
    bucket.fetched.clear()
    names = ("a?b#c%20.obj", "x/d.obj", ".f.obj", "x/", "/g.obj")
    bucket.files = {f"bucket/set/{name}": name.encode() for name in names}
    bucket.files["bucket/settee/e.obj"] = b"e"
    found = find("s3://bucket/set/", work_dir=cache)
    assert [record.uid for record in found.records] == ["a?b#c%20", "x/d"]
    assert [failure.reason for failure in found.failures] == ["unsafe_name"]
    assert Path(found.records[0].path).read_text() == "a?b#c%20.obj"
    assert found.records[1].source_url == "s3://bucket/set/x/d.obj"
    assert find("s3://bucket/set/", work_dir=cache) == found
    assert sorted(bucket.fetched) == ["bucket/set/a?b#c%20.obj", "bucket/set/x/d.obj"]


def test_a_catalogue_that_changed_nothing_is_looked_up_in_one_listing_and_a_folder_is_none(
    bucket: _Bucket,
) -> None:
    rows = [{"uid": name, "path": f"{name}.obj", "licence": "MIT"} for name in "abc"]
    bucket.files["bucket/objects.jsonl"] = "\n".join(map(json.dumps, rows)).encode()
    found = find("s3://bucket")
    bucket.listed.clear()
    assert find("s3://bucket") == found and len(bucket.listed) == 1
    bucket.files = {"bucket/objects.csv/a.obj": b"a"}
    (record,) = find("s3://bucket").records
    assert record.uid == "objects.csv/a"


def gltf(*uris: str) -> str:
    return json.dumps({"buffers": [{"uri": uri, "byteLength": 1} for uri in uris]})


def test_a_listed_folder_is_fetched_at_any_depth(site: Site, cache: Path) -> None:
    site.put("set/b.obj", "B")
    site.put("set/deep/er/a b&c.GLB", "A")
    site.put("set/größe.ply", "G")
    odd = {"latin-%E9": b"L", "line%0Abreak": b"N", "-rf": b"R"}
    site.files |= {f"/set/{name}.obj": data for name, data in odd.items()}
    for name in ("set/notes.txt", "set/.hidden.obj", "set/.git/x.obj", "other/y.obj"):
        site.put(name)
    steps: list[tuple[int, int]] = []
    found = find(f"{site.url}/set", downloaded=lambda *step: steps.append(step))
    read = {record.uid: Path(record.path).read_text() for record in found.records}
    assert list(read) == [
        "-rf", "b", "deep/er/a b&c", "größe", r"latin-\xe9", r"line\nbreak"
    ]  # fmt: skip
    assert "".join(read.values()) == "RBAGLN"
    assert all(Path(record.path).is_relative_to(cache / "objects") for record in found.records)
    assert found.records[2].source_url == f"{site.url}/set/deep/er/a%20b%26c.GLB"
    assert {record.licence for record in found.records} == {USER_PROVIDED}
    assert steps == [(done, 6) for done in range(7)]
    asked = " ".join(site.gets())
    assert not any(word in asked for word in ("hidden", "git", "y.obj"))


def test_a_second_run_fetches_only_what_changed(site: Site) -> None:
    for name in "abc":
        site.put(f"{name}.obj", name)
    first = find(site.url)
    site.requests.clear()
    assert find(site.url) == first
    assert not [path for path in site.gets() if path.endswith(".obj")]
    site.put("b.obj", "B")  # of the same length: only the ETag tells
    site.requests.clear()
    second = find(site.url)
    assert [path for path in site.gets() if path.endswith(".obj")] == ["/b.obj"]
    assert Path(second.records[1].path).read_text() == "B"


def test_a_size_alone_tells_and_what_is_damaged_here_is_mended(site: Site) -> None:
    site.etags = False
    site.put("a.obj", "whole")
    (record,) = find(site.url).records
    site.requests.clear()
    find(site.url)
    assert "/a.obj" not in site.gets()
    Path(record.path).write_text("who")
    find(site.url)
    assert Path(record.path).read_text() == "whole"
    site.always["/a.obj"] = Fault(no_length=True)  # nothing tells: it is fetched again
    site.put("a.obj", "other")
    find(site.url)
    assert Path(record.path).read_text() == "other"


def test_only_allowed_rows_of_a_catalogue_are_asked_for(site: Site) -> None:
    rows = [
        {"uid": "free", "path": "x/free.glb", "licence": "CC0-1.0", "source_url": "u"},
        {"uid": "again", "path": "x/free.glb", "licence": "CC0-1.0"},
        {"uid": "paid", "path": "x/paid.glb", "licence": "LicenseRef-shop"},
        {"uid": "mute", "path": "x/mute.glb"},
        {"uid": "gone", "path": "x/gone.glb", "licence": "MIT"},
    ]
    site.put("objects.jsonl", "\n".join(json.dumps(row) for row in rows))
    for name in ("free", "paid", "mute", "unlisted"):
        site.put(f"x/{name}.glb", name)
    site.listed = False
    found = find(site.url)
    assert [record.uid for record in found.records] == ["again", "free"]
    assert [record.source_url for record in found.records] == [f"{site.url}/x/free.glb", "u"]
    assert {record.licence_source for record in found.records} == {"objects.jsonl"}
    assert reasons(found) == {
        "gone": "download_failed", "mute": "licence_refused", "paid": "licence_refused",
    }  # fmt: skip
    assert len(found.failures) == 3
    asked = {request.path for request in site.requests}
    assert not asked & {"/x/paid.glb", "/x/mute.glb", "/x/unlisted.glb"}
    assert site.gets()["/x/free.glb"] == 1


def test_a_csv_catalogue_and_two_of_them(site: Site) -> None:
    site.put("objects.csv", "uid,path,licence\na,a.obj,MIT\n")
    site.put("a.obj")
    (record,) = find(site.url).records
    assert (record.licence, record.licence_source) == ("MIT", "objects.csv")
    refusal(site.url, "--licence is 'MIT', but objects.csv states", licence="MIT")
    site.put("objects.jsonl", "{}")
    refusal(site.url, r"objects\.jsonl and objects\.csv.*Remove one")


def test_buffers_of_a_gltf_come_with_it(site: Site) -> None:
    site.put("m/a.gltf", gltf("a%20b.bin", "sub/c.bin", "data:,x", "a%20b.bin"))
    site.put("m/b.gltf", gltf("a%20b.bin"))
    evil = ("../up.bin", "%2e%2e/up.bin", "/etc/x", "http://h/x", "x/../../up.bin", "..")
    site.put("m/evil.gltf", gltf(*evil))
    site.put("m/poor.gltf", gltf("gone.bin"))
    site.put("m/odd.gltf", "[")
    for name in ("m/a b.bin", "m/sub/c.bin", "up.bin"):
        site.put(name, name)
    found = find(site.url)
    assert [record.uid for record in found.records] == ["m/a", "m/b", "m/evil", "m/odd"]
    assert reasons(found) == {"m/poor": "download_failed"}
    assert "gone.bin" in found.failures[0].message
    folder = Path(found.records[0].path).parent
    assert (folder / "a b.bin").read_text() == "m/a b.bin"
    assert (folder / "sub" / "c.bin").read_text() == "m/sub/c.bin"
    assert site.gets()["/m/a%20b.bin"] == 1
    assert not site.gets()["/up.bin"]


def test_names_cannot_lead_out_of_the_cache(site: Site, cache: Path) -> None:
    site.put("a.obj", "good")
    site.put("dot.obj", "good")
    site.pages["/"] = "".join(
        f'<a href="{link}">'
        for link in (
            "a.obj", "../up.obj", "..%2fup.obj", "x%2f..%2f..%2fup.obj", "%2e%2e/up.obj",
            "/up.obj", "%2fetc%2fx.obj", "//evil/x.obj", "http://evil/x.obj", "nul%00.obj",
            "a.obj?C=N;O=D", "#a.obj", "x" * 300 + ".obj", "./a.obj", "./dot.obj", "b//c.obj",
        )
    )  # fmt: skip
    found = find(site.url)
    assert [record.uid for record in found.records] == ["a", "dot"]
    assert set(reasons(found).values()) <= {"unsafe_name", "download_failed"}
    files = [path for path in cache.rglob("*") if path.is_file() and path.suffix != ".json"]
    assert sorted(files) == sorted(Path(record.path) for record in found.records)
    assert not list(cache.parent.rglob("up.obj"))


def test_a_file_and_a_folder_of_one_name(site: Site) -> None:
    rows = [{"uid": n, "path": n, "licence": "MIT"} for n in ("a.obj", "a.obj/b.obj", "c.obj")]
    site.put("objects.jsonl", "\n".join(json.dumps(row) for row in rows))
    for row in rows:
        site.put(row["path"])
    found = find(site.url)
    assert len(found.records) + len(found.failures) == 3
    assert set(reasons(found).values()) == {"unsafe_name"}
    assert "c.obj" in [record.uid for record in found.records]


def test_at_most_eight_at_a_time(site: Site) -> None:
    for number in range(40):
        site.put(f"{number}.obj")
    site.delay_s = 0.01  # so that all that are asked for at once are seen at once
    assert len(find(site.url).records) == 40
    assert 2 <= site.most_busy <= 8


def test_credentials_go_to_the_server_and_nowhere_else(site: Site, cache: Path) -> None:
    site.put("s/a.obj")
    # A name that no digest in a path can spell: "ada" once did, in hexadecimal.
    found = find(f"{site.url.replace('//', '//lovelace:s3%20cret@')}/s?sig=s3cret%2B#x")
    sent = {request.headers["Authorization"] for request in site.requests}
    assert sent == {"Basic bG92ZWxhY2U6czMgY3JldA=="}
    assert {request.path.partition("?")[2] for request in site.requests} == {"sig=s3cret%2B"}
    assert "cret" not in repr(found) and "lovelace" not in repr(found)
    kept = [path for path in cache.rglob("*") if path.is_file()]
    assert len(kept) == 2
    for path in kept:
        assert "cret" not in str(path) and b"cret" not in path.read_bytes()
    with serve() as other:  # nor do they follow to another server
        other.put("elsewhere.obj", "E")
        site.put("t/a.obj", "A")
        site.moved["/t/a.obj"] = f"{other.url}/elsewhere.obj"
        (record,) = find(f"{site.url.replace('//', '//lovelace:s3cret@')}/t?sig=s3cret").records
        assert Path(record.path).read_text() == "E"
        assert other.requests
        assert not any("Authorization" in request.headers for request in other.requests)
        assert not any("s3cret" in request.path for request in other.requests)


def always(path: str, **fault: Any) -> Callable[[Site], None]:
    return lambda site: site.always.update({path: Fault(**fault)})


def grow(site: Site) -> None:
    site.put("b.obj", "x" * 2000)


def grow_in_secret(site: Site) -> None:
    grow(site)
    always("/b.obj", no_length=True)(site)


def test_one_dead_link_costs_one_object(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_source, "MAX_BYTES", 1000)
    monkeypatch.setattr(remote_url, "_SILENCE_S", 0.15)
    rows: list[tuple[Callable[[Site], object], str, str]] = [
        (always("/b.obj", status=404), "download_failed", "no such file"),
        (always("/b.obj", status=500), "download_failed", "status 500"),
        (always("/b.obj", cut_after=3), "download_failed", "Payload"),
        (grow, "too_large_bytes", "2000 bytes; expected <= 1000"),
        (grow_in_secret, "too_large_bytes", "longer than 1000 bytes"),
        (always("/b.obj", silent=True), "download_failed", "no answer in time"),
    ]
    for breaks, reason, message in rows:
        site.always.clear()
        site.requests.clear()
        for name in "abc":
            site.put(f"{name}.obj", f"content of {name}")
        breaks(site)
        found = find(f"{site.url.replace('//', '//lovelace:s3cret@')}/?key=s3cret")
        assert [record.uid for record in found.records] == ["a", "c"], message
        assert reasons(found) == {"b": reason}, message
        text = found.failures[0].message
        assert message in text
        assert "s3cret" not in text and "lovelace" not in text and "Traceback" not in text
        assert not list(Path(found.records[0].path).parent.glob("b.obj*")), message
        assert breaks is not grow or not site.gets()["/b.obj"]


def forbid(name: str) -> Callable[[Site], None]:
    def prepare(site: Site) -> None:
        site.put(name)
        always(f"/{name}", status=403)(site)

    return prepare


def hide_catalogue(site: Site) -> None:
    site.put("objects.jsonl", '{"uid": "a", "path": "a.obj", "licence": "LicenseRef-shop"}')
    site.put("a.obj")
    site.forbidden.add("/objects.jsonl")


def list_without_end(site: Site) -> None:
    vars(site)["page"] = lambda path: '<a href="deeper/">' if path[-1] == "/" else None


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda site: None, "cannot be listed .there is no such file"),
        (lambda site: site.pages.update({"/": "<p>"}), "holds no object"),
        (always("/objects.jsonl", status=500), "cannot be read .*status 500"),
        (forbid("a.obj"), "none of 1 .*403"),
        (lambda site: site.put("objects.jsonl", "{"), "objects.jsonl:1: not JSON"),
        (hide_catalogue, "objects.jsonl is listed but cannot be fetched"),
        (list_without_end, "has no end"),
    ],
)
def test_folders_that_give_nothing(
    site: Site, prepare: Callable[[Site], object], message: str
) -> None:
    prepare(site)
    text = refusal(f"{site.url.replace('//', '//lovelace:s3cret@')}?s3cret", message)
    assert "s3cret" not in text and "lovelace" not in text


def test_what_killed_runs_left_is_cleared_after_a_day(site: Site) -> None:
    site.put("a.obj")
    (record,) = find(site.url).records
    folder = Path(record.path).parent
    for name, age_s in (("old.obj.7.part", 2 * 86400), ("young.obj.7.part", 60)):
        (folder / name).write_bytes(b"x")
        when = time.time() - age_s
        os.utime(folder / name, (when, when))
    find(site.url)
    assert sorted(path.name for path in folder.iterdir()) == ["a.obj", "young.obj.7.part"]


def test_a_full_disk_ends_the_run(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.put("a.obj")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("storage.remote.transfers._fill_http", full)
    with pytest.raises(TrilightError, match="disk is full"):
        find(site.url)
