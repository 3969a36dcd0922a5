"""A server, a cache of its own, no pauses between tries; and short names for finding objects."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.listing import Listing
from pipeline.objects.sources import list_objects
from storage.errors import TrilightError
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


def touch(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("v 0 0 0")


def find(source: Path | str, **options: Any) -> Listing:
    options = {"allowed_licences": DEFAULT_ALLOWED, "work_dir": Path("unused"), **options}
    selection = {name: options.pop(name) for name in {*options} & {"downloaded"}}
    return list_objects(str(source), **options).fetch_selected(**selection)


def refusal(source: Path | str, message: str, **options: Any) -> str:
    """Return the one line in which a source is refused, which says what was expected."""
    with pytest.raises(TrilightError, match=message) as caught:
        find(source, **options)
    text = str(caught.value)
    assert "expected" in text and "\n" not in text
    return text


def reasons(found: Listing) -> dict[str, str]:
    return {failure.item: failure.reason for failure in found.failures}
