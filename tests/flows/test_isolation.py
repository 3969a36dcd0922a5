"""Native code may crash, hang, or eat memory in a child, and costs one call."""

import ctypes
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.isolation import ChildClosed, ChildFailed, ChildLimits, IsolatedChild
from storage.errors import Rejected, TrilightError
from tests.conftest import ROOT

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=2, calls_per_child=3)


def _prepare(folder: str) -> None:
    (Path(folder) / f"started-{os.getpid()}").touch()


def double(value: int) -> int:
    return 2 * value


def reject() -> None:
    raise Rejected("no_faces", "nothing there")


def mistake() -> None:
    raise TrilightError("output: cannot be written.")


def crash() -> None:
    ctypes.string_at(0)


def eat_memory() -> int:
    return len(bytearray(8 << 30))


def hang() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])  # as stubborn as native code
    time.sleep(60)


def kill_itself() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def divide() -> float:
    return 1 / 0


@pytest.fixture
def child(tmp_path: Path) -> Iterator[IsolatedChild]:
    child = IsolatedChild(limits=LIMITS, setup=_prepare, setup_args=(str(tmp_path),))
    yield child
    child.close()


def test_results_and_rejections_come_back(child: IsolatedChild) -> None:
    assert child.call(double, 21) == 42
    with pytest.raises(Rejected, match="no_faces: nothing there"):
        child.call(reject)
    with pytest.raises(TrilightError, match="output: cannot be written"):
        child.call(mistake)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (crash, "crashed_signal_11"),
        (eat_memory, "out_of_memory"),
        (hang, "timeout_wall"),
        (kill_itself, "killed"),
        (divide, "exception: .*ZeroDivisionError"),
    ],
)
def test_a_failure_costs_one_call(child: IsolatedChild, function, reason: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ChildFailed, match=f"(?s){reason}"):
        child.call(function)
    assert child.call(double, 4) == 8


def test_a_child_that_cannot_be_set_up_stops_the_run(tmp_path: Path) -> None:
    child = IsolatedChild(limits=LIMITS, setup=_prepare, setup_args=(str(tmp_path / "nowhere"),))
    with pytest.raises(TrilightError, match=r"cannot be set up.*FileNotFoundError.*doctor"):
        child.call(double, 1)
    child.close()


def test_a_child_is_replaced_after_its_calls(child: IsolatedChild, tmp_path: Path) -> None:
    for _ in range(LIMITS.calls_per_child + 1):
        child.call(double, 1)
    assert len(list(tmp_path.iterdir())) == 2


def test_closing_frees_a_waiting_caller(child: IsolatedChild) -> None:
    failures: list[Exception] = []

    def wait() -> None:
        try:
            child.call(hang)
        except ChildFailed as failure:
            failures.append(failure)

    caller = threading.Thread(target=wait)
    caller.start()
    time.sleep(0.5)
    child.close()
    caller.join(10)
    assert not caller.is_alive()
    assert failures
    with pytest.raises(ChildClosed):
        child.call(double, 1)


def _alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")")[-1].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_children_die_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "parent.py"
    program.write_text(
        textwrap.dedent(
            f"""
            import sys
            sys.path.insert(0, {str(ROOT)!r})
            from pipeline.isolation import ChildLimits, IsolatedChild
            from tests.flows import test_isolation as t
            if __name__ == "__main__":
                limits = ChildLimits(memory_bytes=2 << 30, wall_s=60, calls_per_child=9)
                folder = {str(tmp_path)!r}
                child = IsolatedChild(limits=limits, setup=t._prepare, setup_args=(folder,))
                child.call(t.hang)
            """
        )
    )
    parent = subprocess.Popen([sys.executable, str(program)])
    started: list[Path] = []
    for _ in range(300):
        started = list(tmp_path.glob("started-*"))
        if started:
            break
        time.sleep(0.1)
    assert started
    pid = int(started[0].name.split("-")[1])
    assert _alive(pid)
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 10
    while _alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _alive(pid)
