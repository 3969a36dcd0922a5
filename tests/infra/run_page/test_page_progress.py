"""Pages are written now and then, and never at the price of the training."""

import time
from pathlib import Path

import pytest

from infra.run_page import page_progress
from infra.run_page.page_progress import LEAST_WAIT_FACTOR, LEAST_WAIT_S, PageProgress
from storage.errors import TrilightError
from train.folder import RunFolder


def test_a_page_that_takes_longer_is_written_more_rarely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, took_s, written = 1000.0, 0.001, []

    def written_slowly(root: Path) -> Path:
        nonlocal now_s
        now_s += took_s
        written.append(root)
        raise TrilightError("a full disk stops no training")

    monkeypatch.setattr(page_progress, "write_run_page", written_slowly)
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    progress = PageProgress()
    folder = RunFolder(tmp_path)
    for _ in range(2):
        progress.recorded(folder)
    assert written == [tmp_path]
    now_s += LEAST_WAIT_S + 0.1
    took_s = 10.0
    progress.recorded(folder)
    assert len(written) == 2
    now_s += took_s * LEAST_WAIT_FACTOR - 1
    progress.recorded(folder)
    assert len(written) == 2
    now_s += 2
    progress.recorded(folder)
    assert len(written) == 3
