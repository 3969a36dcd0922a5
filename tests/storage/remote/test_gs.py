"""A bucket of Google Cloud Storage: an emulator of the package registry stands for the server."""

from collections.abc import Iterator
from typing import Any

import pytest

from storage.dataset import Dataset, open_dataset
from storage.errors import TrilightError
from storage.remote import fetch
from storage.remote import url as remote_url
from storage.sample import encode_sample
from storage.training_data import open_training_data
from storage.verify import verify_dataset

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
