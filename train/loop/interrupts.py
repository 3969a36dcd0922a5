"""Ctrl-C, SIGTERM and SIGUSR1 take effect between two steps, when the state can be saved whole.

A validation that is under way is left, and done again by the run that goes on.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import ClassVar

from storage.errors import TrilightError

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
"""Those that ask to stop; SIGUSR1 is what job files ask Slurm for, ahead of the time limit."""

SAVED_STATUS = 75
"""What a process ends with whose state is saved: the same command with --resume goes on. (In BSD's
sysexits.h it is EX_TEMPFAIL: try again.) torchrun does not pass it on."""

ONE_ASKING_S = 1.0
"""Signals within this time are one: torchrun forwards a signal that the terminal sent to all."""


class Stopped(TrilightError):
    """A run obeyed a signal: its state is saved, and --resume goes on from there."""

    exit_status: ClassVar[int] = SAVED_STATUS

    def __init__(self, step: int, command: str | None = None) -> None:
        """Take the steps that are done, and the command that goes on, where it is known."""
        stopped = f"training: stopped at step {step}"
        super().__init__(
            f"{stopped} by a signal, nothing is lost. Run the same command with --resume to go on."
            if command is None
            else f"{stopped}, nothing is lost. To go on: {command}"
        )
        self.step = step


class ValidationLeft(Exception):
    """A validation was left, because the run was asked to stop."""


class Asking:
    """Counts the requests to stop."""

    def __init__(self) -> None:
        self.times = 0
        self._last_s = -ONE_ASKING_S

    def again(self) -> bool:
        """Count a signal unless it is an echo of the one before; return whether it counts."""
        now_s = time.monotonic()
        new = now_s - self._last_s >= ONE_ASKING_S
        if new:
            self._last_s = now_s
            self.times += 1
        return new


@contextmanager
def deferred_interrupts(answer: Callable[[int], None]) -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether the run was asked to stop.

    The first signal is only noted; a second one acts at once, as it did before. Outside of the main
    thread Python delivers no signals, and the answer is always no.

    Args:
        answer: is called with 1, 2, ... at each asking, in a thread: Python itself hears a signal
            only when the call at hand returns, which a backward pass on a busy machine does after
            a minute.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    asking, before = Asking(), {number: signal.getsignal(number) for number in SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        asking.again()
        if asking.times > 1:
            restore()
            signal.raise_signal(number)

    for number in SIGNALS:
        signal.signal(number, note)
    try:
        with _heard_at_once(answer):
            yield lambda: asking.times > 0
    finally:
        restore()


@contextmanager
def _heard_at_once(answer: Callable[[int], None]) -> Iterator[None]:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    asking = Asking()

    def listen() -> None:
        while heard := os.read(reading, 1):
            if heard[0] in SIGNALS and asking.again():
                answer(asking.times)

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(writing)
        listener.join()
        os.close(reading)
