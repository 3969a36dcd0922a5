"""Writing to a bucket: whole, only once where that is asked for, and only where that can be."""

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.making.dataset_order import DatasetOrder
from storage.errors import EnvironmentFailure, TrilightError
from storage.remote import bucket as remote_bucket
from storage.remote.tries import with_tries
from storage.remote.url import RemoteUrl
from tests.for_each import for_each
from tests.pipeline.making.bucket_kit import empty_bucket

pytest.importorskip("s3fs", reason="needs the package s3fs (setup-all)")
pytest.importorskip("moto", reason="needs the package moto with its server (setup-all)")


@pytest.fixture
def bucket(moto: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    with empty_bucket(moto, monkeypatch) as driver:
        yield driver


def test_large_files_come_in_parts_and_only_once(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_bucket, "_PART_BYTES", 5 << 20)  # no server takes smaller parts
    place = remote_bucket.Bucket(RemoteUrl(what="out", scheme="s3", root="shards/set"))
    content = bytes(range(256)) * (11 << 12)
    (tmp_path / "large").write_bytes(content)
    assert place.create("part-0001/large", tmp_path / "large")
    (tmp_path / "large").write_bytes(content[::-1])
    assert not place.create("part-0001/large", tmp_path / "large")
    assert not place.create("part-0001/large", b"small")
    assert bucket.cat_file("shards/set/part-0001/large") == content
    assert place.names() == {"part-0001/large"}


def test_a_server_that_ignores_conditions_is_refused(
    bucket: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = remote_bucket.Bucket(RemoteUrl(what="out", scheme="s3", root="shards/set"))
    place.require_create()
    place.require_create()  # what is left of the first time says nothing
    put = remote_bucket.Bucket._put
    monkeypatch.setattr(
        remote_bucket.Bucket,
        "_put",
        lambda self, name, content, mode: put(self, name, content, mode="overwrite"),
    )
    with pytest.raises(TrilightError, match="^out 's3://shards/set': .* conditional writes"):
        place.require_create()


@for_each(
    ("out", "message"),
    [
        ("s3://ada:hunter2@shards/set", "out 's3://shards/set' came with a user or password"),
        ("s3://shards/set?key=hunter2", "out 's3://shards/set' has a query"),
        ("https://ada:hunter2@host/set", "out 'https://host/set' has the scheme 'https'; expected"),
        ("hf://datasets/ada/set", "has the scheme 'hf'; expected a folder, or a URL of s3 or gs"),
        ("s3://", "names no host or bucket"),
        ("ftp://host/set", "has the scheme 'ftp'"),
        ("pipe:cat", "is a pipe: command"),
    ],
)
def test_places_that_cannot_be_written_are_refused_by_name(out: str, message: str) -> None:
    with pytest.raises(TrilightError, match="^out ") as caught:
        DatasetOrder(out=out)
    assert message in str(caught.value)
    assert "hunter2" not in str(caught.value)


def test_a_full_disk_may_pass_whichever_way_the_bytes_go() -> None:
    def full() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(EnvironmentFailure, match="^the disk is full. What was finished is safe"):
        with_tries(full)
