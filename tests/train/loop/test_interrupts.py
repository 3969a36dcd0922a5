"""Ctrl-C is answered at once and obeyed at the end of the step; a second one ends the run."""

import ctypes
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from train.loop import interrupts
from train.loop.interrupts import deferred_interrupts

NEVER_S = 60
TIMED_OUT = 110
"""errno's ETIMEDOUT."""


class TimeSpec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


@pytest.fixture(autouse=True)
def handled() -> Iterator[None]:
    """Tests that run in the background of a shell begin with a SIGINT that is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_it_is_answered_while_the_main_thread_is_in_a_call_that_does_not_return() -> None:
    """As a backward pass: Python's own handlers wait until it does. Here it waits for the answer.

    A mutex of the C library, because nothing of Python's blocks without hearing signals.
    """
    c, mutex = ctypes.CDLL(None), (ctypes.c_byte * 64)()
    answers: list[tuple[int, bool]] = []

    def answer(times: int) -> None:
        answers.append((times, threading.current_thread() is threading.main_thread()))
        c.pthread_mutex_unlock(mutex)

    assert c.pthread_mutex_lock(mutex) == 0
    deadline = TimeSpec(int(time.time()) + NEVER_S, 0)
    main = threading.main_thread().ident
    assert main is not None
    with deferred_interrupts(answer) as asked_to_stop:
        assert not asked_to_stop()
        press = threading.Timer(0.1, signal.pthread_kill, (main, signal.SIGINT))
        press.start()
        ended = c.pthread_mutex_timedlock(mutex, ctypes.byref(deadline))
        press.join()
        assert asked_to_stop()
    assert (ended, answers) == (0, [(1, False)]), ended == TIMED_OUT
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_signal_acts_as_it_did_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interrupts, "ONE_ASKING_S", 0.0)
    with pytest.raises(KeyboardInterrupt), deferred_interrupts(lambda times: None) as asked:
        signal.raise_signal(signal.SIGINT)
        assert asked()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_torchrun_passes_on_is_no_second_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The terminal sends Ctrl-C to all processes, and torchrun sends it to its own once more."""
    monkeypatch.setattr(interrupts, "ONE_ASKING_S", 3600.0)
    answers: list[int] = []
    with deferred_interrupts(answers.append) as asked:
        for number in (signal.SIGINT, signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(number)
        assert asked()
    assert answers == [1]
