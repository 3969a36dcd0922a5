"""A small dataset behind a server, a cache of its own, and no pauses between tries.

Functions beside the fixtures read the first shard of it.
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from storage.dataset.dataset import Dataset, open_dataset
from storage.records.sample import encode_sample
from storage.remote import transfers, url
from tests.http_server import Site, serve
from tests.pipeline.documents.dataset_by_hand import five_scenes
from tests.s3_server import moto as moto
from tests.storage.dataset.test_verify import opened


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the cached shards."""
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("TRILIGHT_SHARD_CACHE_GB", raising=False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(transfers, "PAUSE_S", 0.0)
    return tmp_path / "cache" / "shards"


@pytest.fixture
def local(tmp_path: Path) -> Dataset:
    """Return the same dataset as the server's, in its folder; it verifies."""
    return opened(five_scenes(tmp_path / "served"))


@pytest.fixture
def server(cache: Path, local: Dataset, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setattr(url, "_SILENCE_S", 0.5)
    url._driver_of.cache_clear()  # the silence above is an option of the driver
    with serve(local.folder.root) as running:
        yield running
    url._driver_of.cache_clear()


SHARD = "train-000000.tar"
PATH = f"/{SHARD}"


def read(url: str) -> list[dict[str, bytes]]:
    return expected(open_dataset(url))


def expected(dataset: Dataset) -> list[dict[str, bytes]]:
    return [encode_sample(each) for each in dataset.read_shard(dataset.shards_of("train")[0])]


def with_changed_byte(path: Path) -> bytes:
    """Return the content of a shard with another bit near its end."""
    content = bytearray(path.read_bytes())
    content[-700] ^= 1
    return bytes(content)


def until(happened: Callable[[], object]) -> None:
    """Return when something has happened; the test's own time limit ends it otherwise."""
    while not happened():
        time.sleep(0.02)
