"""What ends a child is tried again in a fresh one, and who is to blame is told apart."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    call_with_retries,
    is_passing,
)
from pipeline.isolation.deaths import ENDS
from storage.errors import EnvironmentFailure
from tests.pipeline.isolation.test_isolation import _nothing, crash, divide, double, kill_itself

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=120, calls_per_child=9)


def die_by(number: int) -> None:
    if number != signal.SIGKILL:  # tests under nohup have children that ignore SIGHUP
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def count_and_die(folder: str, number: int, times: int) -> int:
    """End this process by a signal in the first `times` calls; return how many there were."""
    calls = len(list(Path(folder).iterdir())) + 1
    (Path(folder) / f"call-{calls}").touch()
    if calls <= times:
        os.kill(os.getpid(), number)
    return calls


def set_up_dying(folder: str, number: int, times: int) -> None:
    count_and_die(folder, number, times)


def fail_set_up(folder: str) -> None:
    count_and_die(folder, 0, 0)
    raise ModuleNotFoundError("a library is broken")


def child_with(setup, *args: object) -> IsolatedChild:  # type: ignore[no-untyped-def]
    return IsolatedChild(limits=LIMITS, setup=setup, setup_args=args)


@pytest.fixture
def child() -> Iterator[IsolatedChild]:
    child = child_with(_nothing)
    yield child
    child.close()


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (signal.SIGSEGV, "crashed_signal_11"),
        (signal.SIGABRT, "crashed_signal_6"),
        (signal.SIGFPE, "crashed_signal_8"),
        (signal.SIGKILL, "killed"),
        (signal.SIGTERM, "killed"),
        (signal.SIGHUP, "killed"),
        (signal.SIGBUS, "killed"),
        (signal.SIGXCPU, "killed"),  # a limit of somebody else: these children have none
    ],
)
def test_a_signal_of_native_code_is_told_from_one_of_somebody_else(
    child: IsolatedChild, number: signal.Signals, reason: str
) -> None:
    with pytest.raises(ChildFailed, match=number.name) as caught:
        child.call(die_by, number)
    assert caught.value.reason == reason
    assert caught.value.is_verdict == reason.startswith("crashed_signal")


@pytest.mark.parametrize(("number", "tries"), [(signal.SIGKILL, 3), (signal.SIGSEGV, 2)])
def test_the_same_call_is_made_again(
    child: IsolatedChild, tmp_path: Path, number: int, tries: int
) -> None:
    assert call_with_retries(child, count_and_die, str(tmp_path), number, tries - 1) == tries


@pytest.mark.parametrize(
    ("function", "tries", "is_verdict"),
    [(kill_itself, 3, False), (divide, 3, False), (crash, 2, True)],
)
def test_tries_end(function, tries: int, is_verdict: bool) -> None:  # type: ignore[no-untyped-def]
    calls = 0

    class Counting(IsolatedChild):
        def call(self, function, *args):  # type: ignore[no-untyped-def]
            nonlocal calls
            calls += 1
            return super().call(function, *args)

    child = Counting(limits=LIMITS, setup=_nothing)
    try:
        with pytest.raises(ChildFailed) as caught:
            call_with_retries(child, function)
    finally:
        child.close()
    assert (calls, caught.value.is_verdict) == (tries, is_verdict)


def test_every_end_has_tries_and_only_two_are_verdicts() -> None:
    """A verdict may be kept, and lead to other data: whoever adds one must say so here."""
    assert {name for name, end in ENDS.items() if end.is_verdict} == {
        "timeout_cpu",
        "crashed_signal",
    }
    assert all(1 <= end.tries <= 3 for end in ENDS.values())
    assert not is_passing("degenerate")


def test_a_kill_while_a_child_is_set_up_is_tried_again(tmp_path: Path) -> None:
    child = child_with(set_up_dying, str(tmp_path), signal.SIGKILL, 2)
    try:
        assert child.call(double, 4) == 8
    finally:
        child.close()
    assert len(list(tmp_path.iterdir())) == 3


def test_kills_of_every_set_up_end_the_run(tmp_path: Path) -> None:
    child = child_with(set_up_dying, str(tmp_path), signal.SIGKILL, 99)
    with pytest.raises(EnvironmentFailure, match="cannot be set up.*SIGKILL.*doctor"):
        child.call(double, 4)
    assert len(list(tmp_path.iterdir())) == 3


def test_a_set_up_that_cannot_succeed_is_tried_once_at_each_call(tmp_path: Path) -> None:
    """And no call is made in a child that was not set up."""
    child = child_with(fail_set_up, str(tmp_path))
    try:
        for calls in (1, 2):
            with pytest.raises(EnvironmentFailure, match="cannot be set up.*a library is broken"):
                child.call(double, 4)
            assert len(list(tmp_path.iterdir())) == calls
    finally:
        child.close()
