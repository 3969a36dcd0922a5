"""A bucket: a real S3 server of the package registry, broken lines, missing keys, wrong access."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.training_data import open_training_data
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from storage.remote import fetch, tries
from storage.remote import url as remote_url
from tests.s3_server import CREDENTIALS, Line, control

pytest.importorskip("s3fs", reason="needs the package s3fs (setup-all)")
pytest.importorskip("moto", reason="needs the package moto with its server (setup-all)")

SHARD = "train-000000.tar"


@pytest.fixture
def bucket(
    moto: int, local: Dataset, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Line]:
    """Put the small dataset into a bucket; returns the line to it."""
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


def test_a_bucket_holds_the_same_dataset(bucket: Line, local: Dataset) -> None:
    assert read() == expected(local)
    assert verify_dataset("s3://shards/set").problems == []
    shards = open_training_data(["s3://shards/set/train-{000000..000001}.tar"]).split("train")
    assert [shards.num_samples(number) for number in range(2)] == [2, 2]


def test_interrupted_reads_go_on(bucket: Line, local: Dataset) -> None:
    dataset = open_dataset("s3://shards/set")
    bucket.cuts = [2000, 500, 3000]
    shard = dataset.shards_of("train")[0]
    assert [encode_sample(sample) for sample in dataset.read_shard(shard)] == expected(local)
    assert not bucket.cuts


def test_missing_keys_and_changed_bytes_are_named(bucket: Line, local: Dataset) -> None:
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
        read("s3://no-such-bucket/set")


def test_wrong_access_is_named_without_secrets(
    bucket: Line, moto: int, monkeypatch: pytest.MonkeyPatch
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
