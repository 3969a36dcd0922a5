"""Buckets of S3 and Google: the same dataset again, written whole and once, mistakes named."""

import errno
import os
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

import pytest

from pipeline.making.bucket_publication import begin_dataset, joined
from pipeline.making.dataset_order import DatasetOrder
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import dataset_folder
from storage.dataset.training_data import open_training_data
from storage.dataset.verify import verify_dataset
from storage.errors import EnvironmentFailure, TrilightError
from storage.records.sample import encode_sample
from storage.remote import bucket as remote_bucket
from storage.remote import fetch, tries
from storage.remote import url as remote_url
from storage.remote.bucket import Bucket
from storage.remote.tries import with_tries
from storage.remote.url import RemoteUrl
from tests.for_each import for_each
from tests.pipeline.making.bucket_kit import empty_bucket
from tests.pipeline.making.test_publication import ENVIRONMENT, _build
from tests.s3_server import CREDENTIALS, Line, control

pytest.importorskip("s3fs", reason="needs the package s3fs (setup-all)")
pytest.importorskip("moto", reason="needs the package moto with its server (setup-all)")

SHARD = "train-000000.tar"


@pytest.fixture
def s3(moto: int, local: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Line]:
    """Put the small dataset into a s3; returns the line to it."""
    line = Line(moto)
    for name, value in {
        **CREDENTIALS,
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{line.port}",
    }.items():
        monkeypatch.setenv(name, value)
    control(moto, "reset")
    monkeypatch.setattr(fetch, "PIECE_BYTES", 4096)
    monkeypatch.setattr(tries, "PAUSE_S", 0.0)
    remote_url._driver_of.cache_clear()
    driver = remote_url.open_driver(remote("s3://shards"))
    driver.mkdir("shards")
    for path in local.folder.root.iterdir():
        driver.pipe_file(f"shards/set/{path.name}", path.read_bytes())
    yield line
    line.listener.close()
    remote_url._driver_of.cache_clear()


def remote(text: str) -> Any:
    return remote_url.parse_url(text, what="dataset")


def read(url: str = "s3://shards/set") -> list[dict[str, bytes]]:
    dataset = open_dataset(url)
    shard = dataset.shards_of("train")[0]
    return [encode_sample(sample) for sample in dataset.read_shard(shard)]


def expected(local: Dataset) -> list[dict[str, bytes]]:
    return [encode_sample(sample) for sample in local.read_shard(local.shards_of("train")[0])]


def test_a_bucket_holds_the_same_dataset(s3: Line, local: Dataset) -> None:
    assert read() == expected(local)
    assert verify_dataset("s3://shards/set").problems == []
    shards = open_training_data(["s3://shards/set/train-{000000..000001}.tar"]).split("train")
    assert [shards.num_samples(number) for number in range(2)] == [2, 2]


def test_interrupted_reads_go_on(s3: Line, local: Dataset) -> None:
    dataset = open_dataset("s3://shards/set")
    s3.cuts = [2000, 500, 3000]
    shard = dataset.shards_of("train")[0]
    assert [encode_sample(sample) for sample in dataset.read_shard(shard)] == expected(local)
    assert not s3.cuts


def test_missing_keys_and_changed_bytes_are_named(s3: Line, local: Dataset) -> None:
    driver = remote_url.open_driver(remote("s3://shards"))
    content = bytearray((local.folder.root / SHARD).read_bytes())
    content[-700] ^= 1
    driver.pipe_file(f"shards/set/{SHARD}", bytes(content))
    driver.rm_file("shards/set/test-000005.tar")
    assert verify_dataset("s3://shards/set", fast=True).bad_shards == ["test-000005.tar"]
    found = verify_dataset("s3://shards/set")
    assert set(found.bad_shards) == {"test-000005.tar", SHARD}
    with pytest.raises(TrilightError, match="sha256 differs, 2 times"):
        read()
    with pytest.raises(TrilightError, match=r"no manifest\.json here"):
        read("s3://shards/elsewhere")
    with pytest.raises(TrilightError, match=r"no manifest\.json here"):
        read("s3://no-such-s3/set")


def test_wrong_access_is_named_without_secrets(
    s3: Line, moto: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = open_dataset("s3://shards/set")
    control(moto, "reset-auth", b"0")
    try:
        with pytest.raises(TrilightError) as caught:
            list(dataset.read_shard(dataset.shards_of("train")[0]))
        with pytest.raises(TrilightError, match="manifest.*cannot be read"):
            open_dataset("s3://shards/set")
    finally:
        control(moto, "reset-auth", b"inf")
    text = str(caught.value)
    assert "cannot be read" in text and "Check the URL and your access" in text
    assert "s3cret" not in text and os.environ["AWS_SECRET_ACCESS_KEY"] not in text


pytest.importorskip("gcsfs", reason="gs:// needs the package gcsfs")
emulator: Any = pytest.importorskip(
    "gcp_storage_emulator.server", reason="needs the package gcp-storage-emulator"
)

SHARD = "train-000000.tar"


@pytest.fixture
def gs(local: Dataset, cache: object, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Put the small dataset into a gs; returns the driver of it."""
    server = emulator.create_server("127.0.0.1", 0, in_memory=True, default_bucket="shards")
    server.start()
    port = server._api._httpd.server_address[1]
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", f"http://127.0.0.1:{port}")
    monkeypatch.setattr(fetch, "PIECE_BYTES", 4096)
    remote_url._driver_of.cache_clear()
    driver = remote_url.open_driver(place("gs://shards"))
    for path in local.folder.root.iterdir():
        driver.pipe_file(f"shards/set/{path.name}", path.read_bytes())
    yield driver
    remote_url._driver_of.cache_clear()
    server.stop()


@pytest.fixture
def conditional(gs: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Teach the emulator, which ignores it, what Google's server does with ifGenerationMatch=0."""
    upload = emulator.objects.upload_partial
    handlers = next(row[-1] for row in emulator.HANDLERS if upload in row[-1].values())

    def looking(handler: Any) -> Any:
        def handle(request: Any, response: Any, storage: Any, *more: Any, **options: Any) -> None:
            query, data = request.query, request.data
            if query.get("ifGenerationMatch") == ["0"]:
                name = query["name"][0] if "name" in query else data["meta"]["name"]
                if (request.params["bucket_name"], name) in _files(storage):
                    response.status = HTTPStatus.PRECONDITION_FAILED
                    response.json({"error": {"code": 412, "message": "conditionNotMet"}})
                    return
            handler(request, response, storage, *more, **options)

        return handle

    for method, handler in list(handlers.items()):
        monkeypatch.setitem(handlers, method, looking(handler))


def _files(storage: Any) -> set[tuple[str, str]]:
    return {(gs, name) for gs, rows in storage.objects.items() for name in rows}


def place(text: str) -> Any:
    return remote_url.parse_url(text, what="dataset")


def samples(dataset: Dataset) -> list[dict[str, bytes]]:
    return [encode_sample(s) for s in dataset.read_shard(dataset.shards_of("train")[0])]


def test_a_bucket_holds_the_same_dataset(gs: Any, local: Dataset) -> None:
    remote = open_dataset("gs://shards/set")
    assert remote.manifest == local.manifest
    assert samples(remote) == samples(local)
    assert verify_dataset("gs://shards/set").problems == []
    shards = open_training_data(["gs://shards/set/train-{000000..000001}.tar"]).split("train")
    assert [shards.num_samples(number) for number in range(2)] == [2, 2]


def test_missing_files_and_changed_bytes_are_named(gs: Any, local: Dataset) -> None:
    content = bytearray((local.folder.root / SHARD).read_bytes())
    content[-700] ^= 1
    gs.pipe_file(f"shards/set/{SHARD}", bytes(content))
    gs.rm_file("shards/set/test-000005.tar")
    assert verify_dataset("gs://shards/set", fast=True).bad_shards == ["test-000005.tar"]
    with pytest.raises(TrilightError, match="sha256 differs, 2 times"):
        samples(open_dataset("gs://shards/set"))
    for elsewhere in ("gs://shards/elsewhere", "gs://no-such-gs/set"):
        with pytest.raises(TrilightError, match=r"no manifest\.json here"):
            open_dataset(elsewhere)


def test_a_file_is_created_once(gs: Any, conditional: None, tmp_path: Path) -> None:
    """In one request and, from 5 MiB on, in several; what is written otherwise replaces it."""
    made = Bucket(place("gs://shards/made"))
    content = bytes(range(256)) * (6 << 12)
    (tmp_path / "large").write_bytes(content)
    for name, first in (("small", b"small"), ("part-0001/large", tmp_path / "large")):
        assert made.create(name, first), name
        assert not made.create(name, b"second"), name
        assert not made.create(name, tmp_path / "large"), name
    assert gs.cat_file("shards/made/small") == b"small"
    assert gs.cat_file("shards/made/part-0001/large") == content
    made.write("small", b"third")
    assert gs.cat_file("shards/made/small") == b"third"
    assert made.names() == {"small", "part-0001/large"}
    made.require_create()
    made.require_create()


def test_a_server_that_ignores_the_condition_is_refused_before_anything_is_begun(
    gs: Any,
) -> None:
    """The emulator as it is; two makers could each replace what the other has put there."""
    folder = dataset_folder("gs://shards/made")
    with (
        pytest.raises(TrilightError, match="^out 'gs://shards/made': .*conditional writes"),
        joined(folder),
    ):
        begin_dataset(folder, _build(), ENVIRONMENT, 8, accept_environment=False)
    assert Bucket(place("gs://shards/made")).names() == {".staging/once"}
    assert not folder.manifest.exists()


pytest.importorskip("s3fs", reason="needs the package s3fs (setup-all)")
pytest.importorskip("moto", reason="needs the package moto with its server (setup-all)")


@pytest.fixture
def empty(moto: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    with empty_bucket(moto, monkeypatch) as driver:
        yield driver


def test_large_files_come_in_parts_and_only_once(
    empty: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_bucket, "_PART_BYTES", 5 << 20)  # no server takes smaller parts
    place = remote_bucket.Bucket(RemoteUrl(what="out", scheme="s3", root="shards/set"))
    content = bytes(range(256)) * (11 << 12)
    (tmp_path / "large").write_bytes(content)
    assert place.create("part-0001/large", tmp_path / "large")
    (tmp_path / "large").write_bytes(content[::-1])
    assert not place.create("part-0001/large", tmp_path / "large")
    assert not place.create("part-0001/large", b"small")
    assert empty.cat_file("shards/set/part-0001/large") == content
    assert place.names() == {"part-0001/large"}


def test_a_server_that_ignores_conditions_is_refused(
    empty: Any, monkeypatch: pytest.MonkeyPatch
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
        ("s3://", "names no host or empty"),
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
