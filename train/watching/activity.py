"""What a process is doing right now, and how long each part of its steps took."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

PARTS = {
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
"""The parts of a step, and what each is called for people."""


@dataclass(frozen=True)
class Doing:
    """A part that is under way."""

    part: str
    """One of PARTS."""
    since_s: float
    """time.monotonic() at its start."""


class Activity:
    """A clock with one hand: each moment belongs to exactly one part.

    It is read on the host, and never waits for a device. On a processor a part is the time of its
    work. A card works on after it was told what to do: `forward` and `backward` are then the time
    it takes to tell it, and its work shows as `device`, where the host first needs a number of it
    (with several processes also as `exchange`). `data` and `saving` mean the same everywhere.

    Another thread may read `now` while this one goes on.
    """

    def __init__(self) -> None:
        self.now = Doing("other", time.monotonic())
        self._taken_s = dict.fromkeys(PARTS, 0.0)

    def begin(self, part: str) -> None:
        """End the part that is under way, and begin another."""
        moment_s, before = time.monotonic(), self.now
        self._taken_s[before.part] += moment_s - before.since_s
        self.now = Doing(part, moment_s)

    @contextmanager
    def during(self, part: str) -> Iterator[None]:
        """Spend the time of a block on a part, and go back to the one before."""
        before = self.now.part
        self.begin(part)
        try:
            yield
        finally:
            self.begin(before)

    def taken(self) -> dict[str, float]:
        """Return the seconds of each part since the last call."""
        self.begin(self.now.part)
        taken_s, self._taken_s = self._taken_s, dict.fromkeys(PARTS, 0.0)
        return taken_s
