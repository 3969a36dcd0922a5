"""What ends a child is tried again in a fresh one, and who is to blame is told apart."""

import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    call_with_retries,
    deaths,
    is_passing,
)
from pipeline.isolation.deaths import ENDS, with_retries
from storage.errors import EnvironmentFailure
from tests.for_each import for_each
from tests.pipeline.isolation import called

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=120, calls_per_child=9)


def child_with(setup, *args: object) -> IsolatedChild:  # type: ignore[no-untyped-def]
    return IsolatedChild(limits=LIMITS, setup=setup, setup_args=args)


@pytest.fixture(autouse=True)
def _no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deaths, "_PAUSE_S", 0.0)


@pytest.fixture
def child() -> Iterator[IsolatedChild]:
    child = child_with(called.nothing)
    yield child
    child.close()


def test_a_signal_of_native_code_is_told_from_one_of_somebody_else(child: IsolatedChild) -> None:
    with pytest.raises(ChildFailed, match="SIGSEGV") as caught:
        child.call(called.die_by, signal.SIGSEGV)
    assert (caught.value.reason, caught.value.is_verdict) == ("crashed_signal_11", True)
    with pytest.raises(ChildFailed, match="SIGTERM") as caught:
        child.call(called.die_by, signal.SIGTERM)
    assert (caught.value.reason, caught.value.is_verdict) == ("killed", False)


@for_each(
    ("number", "reason"),
    [
        (signal.SIGABRT, "crashed_signal_6"),
        (signal.SIGFPE, "crashed_signal_8"),
        (signal.SIGKILL, "killed"),
        (signal.SIGHUP, "killed"),
        (signal.SIGBUS, "killed"),
        (signal.SIGXCPU, "killed"),  # a limit of somebody else: these children have none
    ],
)
def test_ends_by_other_signals_are_told_apart_by_the_status(
    child: IsolatedChild, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, reason: str
) -> None:
    ended = SimpleNamespace(exitcode=-number, join=lambda timeout_s: None)
    monkeypatch.setattr(child, "_process", ended)
    death = child._death()
    assert (death.reason, death.is_verdict) == (reason, reason != "killed")
    assert number.name in death.message


def test_the_same_call_is_made_again(child: IsolatedChild, tmp_path: Path) -> None:
    assert call_with_retries(child, called.count_and_die, str(tmp_path), signal.SIGKILL, 2) == 3


@for_each(("reason", "end"), ENDS.items())
def test_tries_end(reason: str, end: deaths.End) -> None:
    calls: list[str] = []

    def fail() -> None:
        calls.append(reason)
        raise ChildFailed(reason, "as ever")

    with pytest.raises(ChildFailed) as caught:
        with_retries(fail)
    assert (len(calls), caught.value.is_verdict) == (end.tries, end.is_verdict)


def test_every_end_has_tries_and_only_two_are_verdicts() -> None:
    """A verdict may be kept, and lead to other data: whoever adds one must say so here."""
    assert {name for name, end in ENDS.items() if end.is_verdict} == {
        "timeout_cpu",
        "crashed_signal",
    }
    assert all(1 <= end.tries <= 3 for end in ENDS.values())
    tries = {name: ENDS[name].tries for name in ("killed", "exception", "crashed_signal")}
    assert tries == {"killed": 3, "exception": 3, "crashed_signal": 2}
    assert not is_passing("degenerate")


def test_a_kill_while_a_child_is_set_up_is_tried_again(tmp_path: Path) -> None:
    with closing(child_with(called.set_up_dying, str(tmp_path), signal.SIGKILL, 2)) as child:
        assert child.call(called.double, 4) == 8
    assert len(list(tmp_path.iterdir())) == 3


def test_kills_of_every_set_up_end_the_run(tmp_path: Path) -> None:
    child = child_with(called.set_up_dying, str(tmp_path), signal.SIGKILL, 99)
    with pytest.raises(EnvironmentFailure, match="cannot be set up.*SIGKILL.*doctor"):
        child.call(called.double, 4)
    assert len(list(tmp_path.iterdir())) == 3


def test_a_set_up_that_cannot_succeed_is_tried_once_at_each_call(tmp_path: Path) -> None:
    """And no call is made in a child that was not set up."""
    with closing(child_with(called.fail_set_up, str(tmp_path))) as child:
        for calls in (1, 2):
            with pytest.raises(EnvironmentFailure, match="cannot be set up.*a library is broken"):
                child.call(called.double, 4)
            assert len(list(tmp_path.iterdir())) == calls
