"""A server, a cache of its own, and no pauses between tries."""

import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.remote import tries
from tests.http_server import Site, serve
from tests.pipeline.objects.objaverse.objaverse_kit import HOST, fill_site


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("TRILIGHT_CACHE", str(folder))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(tries, "PAUSE_S", 0.0)
    return folder


@pytest.fixture
def site(cache: Path) -> Iterator[Site]:
    with serve() as running:
        running.ranges = False  # what is cut then stays cut
        yield running


@pytest.fixture
def place(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Send the real package to the small Objaverse; returns where it keeps its files."""
    objaverse = pytest.importorskip("objaverse", reason="needs the package objaverse (setup-all)")
    fill_site(site)
    real = urllib.request.urlretrieve

    def retrieve(url: str, *args: Any) -> Any:
        assert url.startswith(HOST)
        return real(url.replace(HOST, site.url), *args)

    monkeypatch.setattr(urllib.request, "urlretrieve", retrieve)
    folder = tmp_path / "hf-objaverse-v1"
    monkeypatch.setattr(objaverse, "_VERSIONED_PATH", str(folder))
    return folder
