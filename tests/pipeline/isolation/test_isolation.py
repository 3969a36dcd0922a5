"""Native code may crash, hang, stand still or eat memory in a child; stand-ins for libraries."""

import ctypes
import dataclasses
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from multiprocessing import popen_forkserver
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import pytest

from pipeline.isolation import (
    ChildClosed,
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    answers,
    call_failures,
    call_with_retries,
)
from pipeline.isolation.stand_in_library import load_stand_in
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from tests.conftest import ROOT
from tests.for_each import case, for_each
from tests.pipeline.isolation import called

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=60, calls_per_child=3)
LASTING = dataclasses.replace(LIMITS, calls_per_child=9)


@pytest.fixture
def child(tmp_path: Path) -> Iterator[IsolatedChild]:
    args = (str(tmp_path),)
    with closing(IsolatedChild(limits=LIMITS, factory=called.prepare, args=args)) as child:
        yield child


def test_a_child_that_cannot_start_leaves_the_program_as_it_was(
    child: IsolatedChild, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Mock(side_effect=FileNotFoundError("no usable temporary folder"))
    program = ModuleType("__main__")
    monkeypatch.setitem(sys.modules, "__main__", program)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setattr(tempfile, "gettempdir", full)
    before = program, sys.path, os.environ.copy()
    with pytest.raises(Exception, match="temporary folder"):
        child.call(called.double, 21)
    assert (sys.modules["__main__"], sys.path, os.environ.copy()) == before


def test_results_and_rejections_come_back_and_a_failure_costs_one_call(
    child: IsolatedChild,
) -> None:
    assert child.call(called.double, 21) == 42
    with pytest.raises(Rejected, match="no_faces: nothing there"):
        child.call(called.reject)
    with pytest.raises(TrilightError, match="output: cannot be written"):
        child.call(called.mistake)
    failing: tuple[tuple[Callable[[], object], str], ...] = (
        (called.crash, "crashed_signal_11"),
        (called.eat_memory, "out_of_memory"),
        (called.divide, "exception: .*ZeroDivisionError"),
    )
    for function, reason in failing:
        with case(reason), pytest.raises(ChildFailed, match=f"(?s){reason}"):
            child.call(function)
        assert child.call(called.double, 4) == 8


@for_each("times", [1, 3])
def test_a_fork_server_that_is_killed_is_replaced(
    child: IsolatedChild, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    """Its end is seen while it should answer with the number of the new process."""
    real = popen_forkserver.Popen._launch  # type: ignore[attr-defined]
    left = [times]

    def launch(popen: popen_forkserver.Popen, process: object) -> None:
        if left[0]:
            left[0] -= 1
            raise EOFError("unexpected EOF")
        real(popen, process)

    monkeypatch.setattr(popen_forkserver.Popen, "_launch", launch)
    child.retire()
    if times < 3:
        assert child.call(called.double, 4) == 8
    else:
        with pytest.raises(EnvironmentFailure, match="cannot be started"):
            child.call(called.double, 4)


def test_a_child_is_replaced_after_its_calls_or_when_it_is_retired(
    child: IsolatedChild, tmp_path: Path
) -> None:
    for _ in range(LIMITS.calls_per_child + 1):
        child.call(called.double, 1)
    assert len(list(tmp_path.iterdir())) == 2
    first = child.call(called.process_id)
    assert child.call(called.process_id) == first
    child.retire()
    child.retire()
    assert not Path(f"/proc/{first}").exists()
    assert child.call(called.process_id) != first


def test_closing_frees_a_waiting_caller(child: IsolatedChild) -> None:
    failures: list[Exception] = []

    def wait() -> None:
        try:
            child.call(called.hang)
        except (ChildFailed, ChildClosed) as failure:  # closed in the call, or still starting
            failures.append(failure)

    caller = threading.Thread(target=wait)
    caller.start()
    time.sleep(0.2)
    child.close()
    caller.join(10)
    assert not caller.is_alive()
    assert failures
    with pytest.raises(ChildClosed):
        child.call(called.double, 1)


@pytest.mark.slow("kills")
def test_processor_seconds_are_for_one_call_each() -> None:
    """A call that uses them up ends its child; several that stay below do not add up."""
    with closing(IsolatedChild(limits=dataclasses.replace(LASTING, cpu_s=1))) as child:
        assert len({child.call(called.burn, 0.6) for _ in range(3)}) == 1
        with pytest.raises(ChildFailed, match="timeout_cpu: used its 1 processor seconds"):
            child.call(called.burn, 30.0)
        assert child.call(called.double, 4) == 8


def test_waiting_uses_no_processor_seconds() -> None:
    """It uses the time of its call, and costs no more than that."""
    limits = dataclasses.replace(LASTING, wall_s=3, cpu_s=1)
    with closing(IsolatedChild(limits=limits)) as child:
        with pytest.raises(ChildFailed, match="timeout_wall"):
            child.call(called.hang)
        assert child.call(called.double, 4) == 8


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[IsolatedChild]:
    """Looked at twenty times a second, and given up after three quarters of one."""
    monkeypatch.setattr(answers, "LOOK_S", 0.05)
    monkeypatch.setattr(answers, "LOOKS_BEFORE_KILL", 15)
    monkeypatch.setattr(call_failures, "_PAUSE_S", 0.0)
    with closing(IsolatedChild(limits=LASTING)) as watched:
        yield watched


def test_a_stopped_child_is_noticed_and_its_work_done_again(
    watched: IsolatedChild, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One that stays stopped is the fault of the environment."""
    stopped = watched.call(called.process_id)
    os.kill(stopped, signal.SIGSTOP)
    (tmp_path / "go").touch()
    assert call_with_retries(watched, called.wait_for, str(tmp_path / "go")) != stopped
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert f"child process {stopped} has been stopped" in record.getMessage()
    assert f"`kill -CONT {stopped}`" in record.getMessage()
    os.kill(watched.call(called.process_id), signal.SIGSTOP)
    with pytest.raises(ChildFailed, match="stopped: stopped from outside") as caught:
        watched.call(called.process_id)
    assert not caught.value.is_verdict


def test_a_child_that_is_continued_in_time_answers_itself(
    watched: IsolatedChild, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = watched.call(called.process_id)
    os.kill(first, signal.SIGSTOP)

    def go_on() -> None:
        while not caplog.records:
            time.sleep(0.01)
        os.kill(first, signal.SIGCONT)
        time.sleep(1.0)  # longer than a child may be stopped: looks at one that runs do not count
        (tmp_path / "go").touch()

    threading.Thread(target=go_on).start()
    assert watched.call(called.wait_for, str(tmp_path / "go")) == first
    assert len(caplog.records) == 1


PROGRAM = """
import sys
from pipeline.isolation import ChildLimits, IsolatedChild
from tests.pipeline.isolation import called
limits = ChildLimits(memory_bytes=2 << 30, wall_s=2, calls_per_child=9)
child = IsolatedChild(limits=limits)
for path in sys.argv[1:]:
    print(child.call(called.wait_for, path), flush=True)
"""


def test_a_command_that_is_stopped_as_a_whole_goes_on_where_it_was(tmp_path: Path) -> None:
    """As by Ctrl-Z and `fg`: the pause is longer than the child's wall time, and nobody is told."""
    begun, go = tmp_path / "begun", tmp_path / "go"
    begun.touch()
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(begun), str(go)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        process_group=0,
    ) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        os.killpg(process.pid, signal.SIGTSTP)
        time.sleep(2.5)
        assert answers._is_stopped(process.pid) and answers._is_stopped(int(first))
        go.touch()
        os.killpg(process.pid, signal.SIGCONT)
        second, errors = process.communicate(timeout=120)
    assert (second, errors) == (first, "")


_WORD = ctypes.c_uint64


def _aligned_pair() -> Any:
    """Return two numbers at a multiple of 16 bytes, which keep the memory that they are in."""
    room = ctypes.create_string_buffer(32)
    return (_WORD * 2).from_buffer(room, -ctypes.addressof(room) % 16)


def test_sixteen_bytes_are_exchanged_where_all_are_as_expected_and_threads_lose_none() -> None:
    """ctypes holds no lock of Python in a call, so two processors meet."""
    compare_exchange = load_stand_in("libatomic.so.1").__getattr__("__atomic_compare_exchange_16")
    compare_exchange.restype = ctypes.c_bool
    # the last argument is a number of 16 bytes, which two registers hold; then two memory orders
    pointer, number = ctypes.c_void_p, ctypes.c_int
    compare_exchange.argtypes = [pointer, pointer, _WORD, _WORD, number, number]
    value = _aligned_pair()
    value[:] = 5, 6
    for expected in ((5, 7), (4, 6)):
        found = (_WORD * 2)(*expected)
        assert not compare_exchange(ctypes.byref(value), found, 1, 2, 5, 5)
        assert (list(value), list(found)) == ([5, 6], [5, 6])
    found = (_WORD * 2)(5, 6)
    assert compare_exchange(ctypes.byref(value), found, 1, 2, 5, 5)
    assert list(value) == [1, 2]
    value, times = _aligned_pair(), 20_000

    def count() -> None:
        known = (_WORD * 2)(0, 0)
        for _ in range(times):
            while not compare_exchange(
                ctypes.byref(value), known, known[0] + 1, known[1] - 1 & (1 << 64) - 1, 5, 5
            ):
                pass

    with ThreadPoolExecutor(2) as threads:
        for done in [threads.submit(count) for _ in range(2)]:
            done.result()
    assert list(value) == [2 * times, (1 << 64) - 2 * times]


_STAND_INS = """
from pipeline.isolation.stand_in_library import load_stand_in
for name in ("libGL.so.1", "libOpenGL.so.0", "libatomic.so.1"):
    load_stand_in(name)
"""


@pytest.mark.parametrize(
    "use",
    [
        "from pipeline.assets.recipe import missing_filters as it; assert it() == []",
        "from pipeline.renders import mitsuba_variant as it; it.activate(it.choose_variant());"
        "import drjit, mitsuba; assert drjit.sum(drjit.arange(mitsuba.UInt32, 1000000))[0] > 0",
    ],
    ids=["pymeshlab", "mitsuba"],
)
def test_wheels_that_link_to_a_missing_library_run_with_its_stand_in(use: str) -> None:
    """The loader takes a library that is there under the name it looks for, as on a bare system."""
    maps = "assert 'libatomic.so.1.' not in open('/proc/self/maps').read()"
    subprocess.run([sys.executable, "-c", _STAND_INS + use + "\n" + maps], check=True)
