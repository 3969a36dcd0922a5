"""A child that stands still is noticed; a pause of the whole command takes nothing of its time."""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    call_with_retries,
    deaths,
    waiting,
)
from tests.conftest import ROOT
from tests.pipeline.isolation.called import nothing, process_id, wait_for

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=60, calls_per_child=9)


@pytest.fixture
def child(monkeypatch: pytest.MonkeyPatch) -> Iterator[IsolatedChild]:
    """Looked at twenty times a second, and given up after three quarters of one."""
    monkeypatch.setattr(waiting, "LOOK_S", 0.05)
    monkeypatch.setattr(waiting, "LOOKS_BEFORE_KILL", 15)
    monkeypatch.setattr(deaths, "_PAUSE_S", 0.0)
    child = IsolatedChild(limits=LIMITS, setup=nothing)
    yield child
    child.close()


def test_a_stopped_child_is_noticed_and_its_work_done_again(
    child: IsolatedChild, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stopped = child.call(process_id)
    os.kill(stopped, signal.SIGSTOP)
    (tmp_path / "go").touch()
    assert call_with_retries(child, wait_for, str(tmp_path / "go")) != stopped
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert f"child process {stopped} has been stopped" in record.getMessage()
    assert f"`kill -CONT {stopped}`" in record.getMessage()


def test_a_child_that_stays_stopped_is_the_fault_of_the_environment(child: IsolatedChild) -> None:
    os.kill(child.call(process_id), signal.SIGSTOP)
    with pytest.raises(ChildFailed, match="stopped: stopped from outside") as caught:
        child.call(process_id)
    assert not caught.value.is_verdict


def test_a_child_that_is_continued_in_time_answers_itself(
    child: IsolatedChild, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = child.call(process_id)
    os.kill(first, signal.SIGSTOP)

    def go_on() -> None:
        while not caplog.records:
            time.sleep(0.01)
        os.kill(first, signal.SIGCONT)
        time.sleep(1.0)  # longer than a child may be stopped: looks at one that runs do not count
        (tmp_path / "go").touch()

    threading.Thread(target=go_on).start()
    assert child.call(wait_for, str(tmp_path / "go")) == first
    assert len(caplog.records) == 1


CALLED = """
import os, time

def wait_for(path) -> int:
    while not os.path.exists(path):
        time.sleep(0.02)
    return os.getpid()
"""

PROGRAM = """
import sys
sys.path.insert(0, {root!r})
from called import wait_for
from pipeline.isolation import ChildLimits, IsolatedChild

limits = ChildLimits(memory_bytes=2 << 30, wall_s=2, calls_per_child=9)
child = IsolatedChild(limits=limits, setup=int)
print(child.call(wait_for, __file__), flush=True)
print(child.call(wait_for, __file__ + ".go"), flush=True)
"""


def test_a_command_that_is_stopped_as_a_whole_goes_on_where_it_was(tmp_path: Path) -> None:
    """As by Ctrl-Z and `fg`: the pause is longer than the child's wall time, and nobody is told."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM.format(root=str(ROOT)))
    (tmp_path / "called.py").write_text(CALLED)
    with subprocess.Popen(
        [sys.executable, str(program)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    ) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        os.killpg(process.pid, signal.SIGTSTP)
        time.sleep(2.5)
        assert waiting._is_stopped(process.pid) and waiting._is_stopped(int(first))
        (tmp_path / "program.py.go").touch()
        os.killpg(process.pid, signal.SIGCONT)
        second, errors = process.communicate(timeout=120)
    assert (second, errors) == (first, "")
