"""A server, a cache of its own, and no pauses between tries."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.remote import transfers
from tests.http_server import Site, serve


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("TRILIGHT_CACHE", str(folder))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(transfers, "PAUSE_S", 0.0)
    return folder


@pytest.fixture
def site(cache: Path) -> Iterator[Site]:
    with serve() as running:
        running.ranges = False  # what is cut then stays cut
        yield running
