"""A flow that is cancelled tells its program once, and waits until it has saved."""

import signal
import sys
from pathlib import Path

import pytest

from pipeline.flows.process import run_to_end

SAVES = """
import signal, sys, time
from pathlib import Path
told = []
signal.signal(signal.SIGTERM, lambda *_: told.append(1))
print("begun", flush=True)
while not told:
    time.sleep(0.01)
print("x" * 200_000, flush=True)  # more than a pipe holds
time.sleep(0.3)
Path(sys.argv[1]).write_text(str(len(told)))
"""


class Cancelled(BaseException):
    """As Prefect raises it for a SIGTERM."""


def test_what_is_cancelled_is_told_once_and_saves(tmp_path: Path) -> None:
    def cancel(line: str) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        run_to_end([sys.executable, "-c", SAVES, str(tmp_path / "saved")], cancel)
    assert (tmp_path / "saved").read_text() == "1"


def test_status_and_lines_are_passed_on() -> None:
    lines: list[str] = []
    program = "import os, sys; print('a'); print(os.getpgid(0) == os.getpid()); sys.exit(3)"
    assert run_to_end([sys.executable, "-c", program], lines.append) == (3, "True")
    assert lines == ["a", "True"]
    ended = run_to_end([sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"], lines.append)
    assert ended == (-signal.SIGKILL, "")
