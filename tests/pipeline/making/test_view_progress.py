"""A child tells how far its scene is while it renders, and never too often."""

from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from pipeline.making import view_progress
from pipeline.making.view_progress import ViewProgress
from pipeline.renders.results import RenderedView, Sampling
from storage.dataset.layout import DatasetFolder

DONE: Any = object()


def _steps() -> Generator[Sampling, None, RenderedView]:
    for spp in (32, 64, 96, 256):
        yield Sampling(spp=spp, expected_spp=128, missing_db=None)
    return DONE


def _told(folder: DatasetFolder) -> list[str]:
    at_work = folder.staging / "at_work"
    return [path.read_text() for path in at_work.iterdir()] if at_work.is_dir() else []


def test_a_view_counts_in_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 128 samples that are expected, and no more than the whole where there are more."""
    folder, told = DatasetFolder(tmp_path), list[float]()
    monkeypatch.setattr(view_progress, "_EVERY_S", 0.0)
    monkeypatch.setattr(view_progress, "tell_views", lambda *words: told.append(words[2]))
    assert ViewProgress(folder, 5).view(2, _steps()) is DONE
    assert told == [2.25, 2.5, 2.75, 3.0]


def test_quick_passes_are_told_once(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    progress = ViewProgress(folder, 5)
    assert progress.view(0, _steps()) is DONE
    assert progress.view(1, _steps()) is DONE
    assert _told(folder) == ["0.250"]
    progress.end()
    assert _told(folder) == []


def test_where_nobody_looks_nothing_is_written(tmp_path: Path) -> None:
    progress = ViewProgress(None, 5)
    assert progress.view(0, _steps()) is DONE
    progress.end()
    assert not list(tmp_path.iterdir())
