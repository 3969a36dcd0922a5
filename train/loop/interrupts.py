"""Deferral of Ctrl-C, SIGTERM and SIGUSR1 to the end of a step, when the state can be saved.

A validation in progress is interrupted, and repeated by the resumed run.
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
"""Signals that stop a run; Slurm sends SIGUSR1 ahead of the time limit, as job files request."""

SAVED_STATUS = 75
"""Exit status of a process that saved its state: the same command with --resume continues. (In
BSD's sysexits.h it is EX_TEMPFAIL: try again.) torchrun does not forward it."""

ECHO_S = 1.0
"""Time in which a second signal counts as an echo: torchrun forwards what the terminal sent to all.
"""


class Stopped(TrilightError):
    """A run was stopped by a signal after its state was saved; --resume continues it."""

    exit_status: ClassVar[int] = SAVED_STATUS

    def __init__(self, step: int, command: str | None = None) -> None:
        """Create the error from the number of done steps, and the command to resume if known."""
        stopped = f"training: stopped at step {step}"
        super().__init__(
            f"{stopped} by a signal, nothing is lost. Run the same command with --resume to go on."
            if command is None
            else f"{stopped}, nothing is lost. To go on: {command}"
        )
        self.step = step


class ValidationInterrupted(Exception):
    """A validation was interrupted because a signal stops the run."""


class SignalCounter:
    """Counts the signals to stop, without echoes."""

    def __init__(self) -> None:
        self.times = 0
        self._last_s = -ECHO_S

    def count_signal(self) -> bool:
        """Count a signal unless it is an echo of the last one; return whether it counts."""
        now_s = time.monotonic()
        new = now_s - self._last_s >= ECHO_S
        if new:
            self._last_s = now_s
            self.times += 1
        return new


@contextmanager
def deferred_interrupts(on_signal: Callable[[int], None]) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether a signal asked the run to stop.

    The first signal is only recorded; a second one has its usual effect at once. Outside of the
    main thread Python delivers no signals, and the function always returns False.

    Args:
        on_signal: called in a thread with the number of signals so far: Python's own handlers run
            only when the current native call returns, such as a backward pass of a minute.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    counter = SignalCounter()
    before = {number: signal.getsignal(number) for number in SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        counter.count_signal()
        if counter.times > 1:
            restore()
            signal.raise_signal(number)

    for number in SIGNALS:
        signal.signal(number, note)
    try:
        with _listen_in_thread(on_signal):
            yield lambda: counter.times > 0
    finally:
        restore()


@contextmanager
def _listen_in_thread(on_signal: Callable[[int], None]) -> Iterator[None]:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    counter = SignalCounter()

    def listen() -> None:
        while received := os.read(reading, 1):
            if received[0] in SIGNALS and counter.count_signal():
                on_signal(counter.times)

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
