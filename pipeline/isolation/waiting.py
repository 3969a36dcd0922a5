"""Waits for the answer of a child; the time limit does not run while the command is stopped.

Time is counted in polls, not by a clock, and a stopped process does not poll. So Ctrl-Z, which
stops a command and all its children together, and a sleeping laptop take none of a child's time.
"""

import logging
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.isolation.call_failures import ChildFailed

log = logging.getLogger("trilight.children")

LOOK_S = 1.0
"""Pause between two polls of a child that has not answered."""
LOOKS_BEFORE_WORDS = 3
"""Polls that find a child stopped before a warning is logged. A single one may see a child that is
about to continue together with this process."""
LOOKS_BEFORE_KILL = 60
"""Polls that may find a child stopped before it is given up: time to continue it by hand."""


class CallTime:
    """Time limit of one call, shared by all its waits."""

    def __init__(self, process_id: int, wall_s: float) -> None:
        """Begin a call.

        Args:
            process_id: process id of the child.
            wall_s: most seconds to wait in total.
        """
        self._process_id = process_id
        self._wall_s = wall_s
        self._waited_s = 0.0
        self._stopped = 0

    def until(self, happens: Callable[[float], bool]) -> None:
        """Wait until an event happens.

        Args:
            happens: waits at most the given seconds, and returns True if the event has happened.

        Raises:
            ChildFailed: `timeout_wall`, or `stopped` where the child was stopped and not continued.
        """
        while self._waited_s < self._wall_s:
            pause_s = min(LOOK_S, self._wall_s - self._waited_s)
            began_s = time.monotonic()
            if happens(pause_s):  # many short waits count too
                self._waited_s += min(pause_s, time.monotonic() - began_s)
                return
            self._waited_s += pause_s
            self._check_stopped()
        raise ChildFailed("timeout_wall", f"no answer within {self._wall_s:.0f} s")

    def _check_stopped(self) -> None:
        self._stopped = self._stopped + 1 if _is_stopped(self._process_id) else 0
        if self._stopped == LOOKS_BEFORE_WORDS:
            log.warning(
                "child process %d has been stopped from outside. Continue it with `kill -CONT %d`; "
                "otherwise it is ended in %.0f s and its work is done again.",
                self._process_id,
                self._process_id,
                (LOOKS_BEFORE_KILL - self._stopped) * LOOK_S,
            )
        if self._stopped == LOOKS_BEFORE_KILL:
            waited = f"{LOOKS_BEFORE_KILL * LOOK_S:.0f} s"
            raise ChildFailed("stopped", f"stopped from outside (SIGSTOP) for {waited}")


def _is_stopped(process_id: int) -> bool:
    """Return whether a process is stopped until it is continued; False without /proc."""
    try:
        line = Path(f"/proc/{process_id}/stat").read_text()
    except OSError:
        return False
    return line.rpartition(")")[2].split()[0] == "T"
