"""`make serve`: a password as soon as it is not loopback; `make stop`: exactly what was started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from infra.serving.local import running, start, stop
from storage.errors import TrilightError

SLEEP = [sys.executable, "-c", "import time; time.sleep(120)"]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    monkeypatch.delenv("PREFECT_SERVER_API_AUTH_STRING", raising=False)
    (tmp_path / "serve").mkdir()
    return tmp_path / "serve" / "mark"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.7", "my-host"])
def test_an_open_address_needs_a_password(host: str) -> None:
    with pytest.raises(TrilightError, match="expected a password"):
        start(host=host, port=4321, workers=1)
    assert running() == []


def test_stop_ends_what_was_started_and_no_stranger(cache: Path) -> None:
    cache.write_text("ours")
    marks = ("ours", "ours-too", "other")
    processes = [
        subprocess.Popen(SLEEP, env={**os.environ, "TRILIGHT_SERVED": mark}, start_new_session=True)
        for mark in marks
    ]
    try:
        with pytest.raises(TrilightError, match="runs already"):
            start(host="127.0.0.1", port=4321, workers=1)
        assert stop() == 1
        assert processes[0].wait(30) != 0
        assert [process.poll() for process in processes[1:]] == [None, None]
        assert stop() == 0
    finally:
        for process in processes:
            process.kill()
            process.wait()
