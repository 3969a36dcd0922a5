"""Current phase of a training process, and the time spent in each phase."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

PHASES = {
    "data": "waiting for data",
    "forward": "forward pass and loss",
    "backward": "backward pass",
    "device": "waiting for the device",
    "exchange": "exchange with the other processes",
    "optimiser": "clipping and moving the weights",
    "validation": "validation",
    "saving": "saving a checkpoint",
    "other": "batching, counting and writing the log",
}
"""Description of each phase of training, by name."""


@dataclass(frozen=True)
class ActivePhase:
    """Phase in progress."""

    phase: str
    """Name of the phase, one of PHASES."""
    since_s: float
    """Start of the phase, by time.monotonic()."""


class Activity:
    """Timer of phases: each moment belongs to exactly one.

    It measures host time, and never waits for a device. On a CPU a phase is the time of its work. A
    GPU works asynchronously: `forward` and `backward` are then the time to enqueue kernels, and
    their work appears as `device`, where the host first waits for a result (with several processes
    also as `exchange`). `data` and `saving` mean the same everywhere.

    Another thread may read `now` at any time.
    """

    def __init__(self) -> None:
        self.now = ActivePhase("other", time.monotonic())
        self._taken_s = dict.fromkeys(PHASES, 0.0)

    def begin(self, phase: str) -> None:
        """End the current phase, and begin another."""
        moment_s = time.monotonic()
        before = self.now
        self._taken_s[before.phase] += moment_s - before.since_s
        self.now = ActivePhase(phase, moment_s)

    @contextmanager
    def during(self, phase: str) -> Iterator[None]:
        """Assign the time of a block to a phase, then return to the previous one."""
        before = self.now.phase
        self.begin(phase)
        try:
            yield
        finally:
            self.begin(before)

    def pop_seconds(self) -> dict[str, float]:
        """Return the seconds of each phase since the last call, and reset them."""
        self.begin(self.now.phase)
        taken_s = self._taken_s
        self._taken_s = dict.fromkeys(PHASES, 0.0)
        return taken_s
