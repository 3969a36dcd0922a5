"""A bucket, and machines that share nothing else, for who asks for them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.remote import url as remote_url
from tests.pipeline.generation.bucket_kit import Machines, empty_bucket
from tests.s3_server import moto as moto


@pytest.fixture(autouse=True)
def _bare(bare_reports: None) -> None:
    """No test here looks at a figure."""


@pytest.fixture(scope="module")
def _own_drivers() -> Iterator[None]:
    """Keep the drivers of buckets for the tests of one file."""
    remote_url._driver_of.cache_clear()
    yield
    remote_url._driver_of.cache_clear()


@pytest.fixture
def bucket(moto: int, _own_drivers: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    with empty_bucket(moto, monkeypatch, keep_driver=True) as driver:
        yield driver


@pytest.fixture
def machines(bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machines:
    return Machines(tmp_path, monkeypatch)
