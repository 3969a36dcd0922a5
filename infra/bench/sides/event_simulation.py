"""Simulated time: processes that wait, take turns, and may vanish at a time that is drawn before.

A process is a generator. It yields seconds to wait, or a Turn that it wants; the clock goes on with
it when these are over, or the turn is its own. What vanishes gets the exception Vanished there.
"""

import heapq
import itertools
import math
from collections import deque
from collections.abc import Callable, Generator
from typing import TypeAlias

Steps: TypeAlias = Generator["float | Turn", None, None]


class Vanished(Exception):
    """The machine of this process is gone."""


class _Process:
    def __init__(self, steps: Steps, vanishes_at: float) -> None:
        self.steps = steps
        self.vanishes_at = vanishes_at
        self.moves = 0  # events of earlier moves are stale


class Clock:
    """The time, in seconds, and what happens when."""

    def __init__(self) -> None:
        self.now = 0.0
        self._order = itertools.count()  # of what happens at the same time
        self._events: list[tuple[float, int, _Process, int, bool]] = []

    def start(self, steps: Steps, *, after_s: float = 0.0, lasts_s: float = math.inf) -> None:
        """Start a process in `after_s` seconds, which vanishes `lasts_s` later if it still runs."""
        begins = self.now + after_s
        self._at(begins, _Process(steps, begins + lasts_s))

    def run(self) -> None:
        """Go on until nothing can happen any more."""
        while self._events:
            time, _, process, move, vanishes = heapq.heappop(self._events)
            if move == process.moves:
                self.now = time
                self._move(process, vanishes)

    def _move(self, process: _Process, vanishes: bool) -> None:
        process.moves += 1
        try:
            asked = process.steps.throw(Vanished()) if vanishes else next(process.steps)
        except (StopIteration, Vanished):
            return
        if not isinstance(asked, Turn):
            self._at(self.now + asked, process)
        elif not asked.taken_by(process):
            self._at(math.inf, process)

    def _at(self, time: float, process: _Process) -> None:
        """Go on with a process then, or let it vanish before."""
        vanishes = process.vanishes_at < time
        time = min(time, process.vanishes_at)
        if time < math.inf:
            row = (max(time, self.now), next(self._order), process, process.moves, vanishes)
            heapq.heappush(self._events, row)

    def go_on(self, process: _Process, move: int) -> bool:
        """Go on now with a process that has waited since a move; False where it is gone."""
        if process.moves != move:
            return False
        process.moves += 1  # its vanishing while it waits is stale now
        self._at(self.now, process)
        return True


class Turn:
    """What few have at a time; whoever asks first gets it first."""

    def __init__(self, clock: Clock, places: int = 1) -> None:
        self._clock = clock
        self._free = places
        self._waiting: deque[tuple[_Process, int]] = deque()

    def taken_by(self, process: _Process) -> bool:
        """Give a place, or let the process wait for one; called by the clock."""
        if self._free:
            self._free -= 1
            self._clock.go_on(process, process.moves)
            return True
        self._waiting.append((process, process.moves))
        return False

    def left(self) -> None:
        """Give the place to the next one."""
        while self._waiting:
            if self._clock.go_on(*self._waiting.popleft()):
                return
        self._free += 1

    def held(self, seconds: Callable[[], float], *, kept_s: float = 0.0) -> Steps:
        """Wait for a place and keep it for the seconds that are said once it is there.

        What vanishes meanwhile frees its place only `kept_s` later, as a lease on a lock does.
        """
        yield self
        try:
            yield seconds()
        except Vanished:
            self._clock.start(self._leave_later(kept_s))
            raise
        self.left()

    def _leave_later(self, seconds: float) -> Steps:
        yield seconds
        self.left()
