"""A bucket of Google Cloud Storage: an emulator of the package registry stands for the server."""

from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any

import pytest

from pipeline.making.bucket_publication import begin_dataset, joined
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import dataset_folder
from storage.dataset.training_data import open_training_data
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from storage.remote import fetch
from storage.remote import url as remote_url
from storage.remote.bucket import Bucket
from tests.pipeline.making.test_publication import ENVIRONMENT, _build

pytest.importorskip("gcsfs", reason="gs:// needs the package gcsfs")
emulator: Any = pytest.importorskip(
    "gcp_storage_emulator.server", reason="needs the package gcp-storage-emulator"
)

SHARD = "train-000000.tar"


@pytest.fixture
def bucket(local: Dataset, cache: object, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Put the small dataset into a bucket; returns the driver of it."""
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
def conditional(bucket: Any, monkeypatch: pytest.MonkeyPatch) -> None:
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
    return {(bucket, name) for bucket, rows in storage.objects.items() for name in rows}


def place(text: str) -> Any:
    return remote_url.parse_url(text, what="dataset")


def samples(dataset: Dataset) -> list[dict[str, bytes]]:
    return [encode_sample(s) for s in dataset.read_shard(dataset.shards_of("train")[0])]


def test_a_bucket_holds_the_same_dataset(bucket: Any, local: Dataset) -> None:
    remote = open_dataset("gs://shards/set")
    assert remote.manifest == local.manifest
    assert samples(remote) == samples(local)
    assert verify_dataset("gs://shards/set").problems == []
    shards = open_training_data(["gs://shards/set/train-{000000..000001}.tar"]).split("train")
    assert [shards.num_samples(number) for number in range(2)] == [2, 2]


def test_missing_files_and_changed_bytes_are_named(bucket: Any, local: Dataset) -> None:
    content = bytearray((local.folder.root / SHARD).read_bytes())
    content[-700] ^= 1
    bucket.pipe_file(f"shards/set/{SHARD}", bytes(content))
    bucket.rm_file("shards/set/test-000005.tar")
    assert verify_dataset("gs://shards/set", fast=True).bad_shards == ["test-000005.tar"]
    with pytest.raises(TrilightError, match="sha256 differs, 2 times"):
        samples(open_dataset("gs://shards/set"))
    for elsewhere in ("gs://shards/elsewhere", "gs://no-such-bucket/set"):
        with pytest.raises(TrilightError, match=r"no manifest\.json here"):
            open_dataset(elsewhere)


def test_a_file_is_created_once(bucket: Any, conditional: None, tmp_path: Path) -> None:
    """In one request and, from 5 MiB on, in several; what is written otherwise replaces it."""
    made = Bucket(place("gs://shards/made"))
    content = bytes(range(256)) * (6 << 12)
    (tmp_path / "large").write_bytes(content)
    for name, first in (("small", b"small"), ("part-0001/large", tmp_path / "large")):
        assert made.create(name, first), name
        assert not made.create(name, b"second"), name
        assert not made.create(name, tmp_path / "large"), name
    assert bucket.cat_file("shards/made/small") == b"small"
    assert bucket.cat_file("shards/made/part-0001/large") == content
    made.write("small", b"third")
    assert bucket.cat_file("shards/made/small") == b"third"
    assert made.names() == {"small", "part-0001/large"}
    made.require_create()
    made.require_create()


def test_a_server_that_ignores_the_condition_is_refused_before_anything_is_begun(
    bucket: Any,
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
