"""Which sources are folders, which are servers, and which are refused before anything is opened."""

import builtins
import sys
from pathlib import Path
from typing import Any

import pytest

from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.remote import source as remote_source
from pipeline.objects.sources import list_objects
from storage.errors import TrilightError
from storage.remote.url import PACKAGES, RemoteUrl, open_driver, parse_url
from tests.for_each import for_each
from tests.pipeline.objects.find_kit import find


@for_each(
    "source, path",
    [
        ("objects", "objects"),
        ("/a/b c", "/a/b c"),
        ("file:///a/b%20c", "/a/b c"),
        ("file://localhost/a", "/a"),
        ("FILE:///a", "/a"),
        ("C:x", "C:x"),
        ("a::b", "a::b"),
    ],
)
def test_folders_of_this_machine(source: str, path: str) -> None:
    assert parse_url(source, what="objects") == Path(path)


@for_each(
    "source, scheme, root",
    [
        ("https://host/a/b/", "https", "https://host/a/b"),
        ("HTTP://host", "http", "http://host"),
        ("http://host/a b/ä%20", "http", "http://host/a%20b/%C3%A4%20"),
        ("http://ada:s3@cret@host:1/a?k=1&l#m", "http", "http://host:1/a"),
        ("http://[::1]:8000/a", "http", "http://[::1]:8000/a"),
        ("http://ada:x@[fe80::1]/a", "http", "http://[fe80::1]/a"),
        ("s3://bucket/a b/?#/", "s3", "bucket/a b/?#"),
        ("gs://bucket", "gs", "bucket"),
        ("hf://datasets/ada/set@main/a", "hf", "datasets/ada/set@main/a"),
    ],
)
def test_folders_of_servers(source: str, scheme: str, root: str) -> None:
    url = parse_url(source, what="objects")
    assert isinstance(url, RemoteUrl)
    assert (url.scheme, url.root) == (scheme, root)
    assert "cret" not in repr(url) and "cret" not in url.display_url


def test_credentials_are_kept_apart() -> None:
    url = parse_url("http://a%40da:s3@cret@host/x?k=1&l=&k=2#m", what="objects")
    assert isinstance(url, RemoteUrl)
    assert (url.user, url.password) == ("a@da", "s3@cret")
    assert url.query == (("k", "1"), ("l", ""), ("k", "2"))


@for_each(
    "source, message",
    [
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
    ],
)
def test_other_urls_are_refused(tmp_path: Path, source: str, message: str) -> None:
    with pytest.raises(TrilightError, match=message) as caught:
        find(source, work_dir=tmp_path)
    assert "expected" in str(caught.value)
    assert "s3cret" not in str(caught.value)
    assert "ada" not in str(caught.value)


@pytest.mark.parametrize("scheme", sorted(PACKAGES))
def test_a_missing_driver_is_named(scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, PACKAGES[scheme], None)
    url = parse_url(f"{scheme}://host/a", what="objects")
    assert isinstance(url, RemoteUrl)
    with pytest.raises(TrilightError, match=f"pip install {PACKAGES[scheme]}"):
        open_driver(url)


class _Bucket:
    """What s3fs, gcsfs and huggingface_hub have in common, over fsspec's own memory."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files = files
        self.fetched: list[str] = []
        self.sizes = True

    def info(self, address: str) -> dict[str, Any]:
        if address not in self.files:
            raise FileNotFoundError(address)
        data = self.files[address]
        size = len(data) if self.sizes else None
        return {"name": address, "type": "file", "size": size, "ETag": hash(data)}

    def find(self, root: str, *, detail: bool) -> dict[str, dict[str, Any]]:
        return {name: self.info(name) for name in self.files if name.startswith(root)}

    def get_file(self, address: str, path: str, callback: Any) -> None:
        self.fetched.append(address)
        with builtins.open(path, "wb") as stream:
            stream.write(self.files[address])
        callback.relative_update(len(self.files[address]))


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> _Bucket:
    """The bucket that any address leads to."""
    made = _Bucket({f"bucket/{name}.obj": name.encode() for name in "abc"})
    monkeypatch.setattr("pipeline.objects.remote.folder.open_driver", lambda url: made)
    return made


def test_a_bucket_is_listed_at_once(bucket: _Bucket, cache: Path) -> None:
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


def test_what_is_not_wanted_stays_on_the_server(bucket: _Bucket, cache: Path) -> None:
    listed = list_objects("s3://bucket", work_dir=cache, allowed_licences=DEFAULT_ALLOWED)
    assert bucket.fetched == []
    found = listed.fetch_selected(lambda uid: uid == "b")
    assert [record.uid for record in found.records] == ["b"]
    assert bucket.fetched == ["bucket/b.obj"]
    assert listed.num_found == 3


def test_a_transfer_that_grows_too_large_is_ended(
    bucket: _Bucket, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server does not say how large it is, and has no end."""
    del bucket.files["bucket/c.obj"]
    chunks: list[int] = []

    def get_file(address: str, path: str, callback: Any) -> None:
        Path(path).write_bytes(b"x" * 100)
        for _ in range(1 if address == "bucket/a.obj" else 10_000):
            chunks.append(100)
            callback.relative_update(100)

    bucket.sizes = False
    monkeypatch.setattr(bucket, "get_file", get_file)
    monkeypatch.setattr(remote_source, "MAX_BYTES", 1000)
    found = find("gs://bucket", work_dir=cache)
    assert [record.uid for record in found.records] == ["a"]
    assert [one.reason for one in found.failures] == ["too_large_bytes"]
    assert len(chunks) == 1 + 11
