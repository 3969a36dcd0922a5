"""Waits for the answer of a child, within a time limit that does not run while it is stopped.

Time is counted in polls, not by a clock, and this process does not poll while it stands still.
So Ctrl-Z, which stops a command and all of its children together, and a laptop that sleeps take
nothing of a child's time, however long they last.
"""

import logging
from multiprocessing.connection import Connection
from pathlib import Path

from pipeline.isolation.deaths import ChildFailed

log = logging.getLogger("trilight.children")

LOOK_S = 1.0
"""Pause between two polls of a child that has not answered."""
LOOKS_BEFORE_WORDS = 3
"""Looks at which a child was stopped before that is said. One may see a child that is about to
continue together with this process."""
LOOKS_BEFORE_KILL = 60
"""Polls that may find a child stopped before it is given up: time to continue it by hand."""


def wait_for_answer(connection: Connection, process_id: int, wall_s: float) -> None:
    """Return as soon as the connection has something to receive: an answer, or its end.

    Args:
        connection: to the child.
        process_id: of the child.
        wall_s: most seconds to wait.

    Raises:
        ChildFailed: `timeout_wall`, or `stopped` where the child was stopped and not continued.
    """
    waited_s, stopped = 0.0, 0
    while waited_s < wall_s:
        pause_s = min(LOOK_S, wall_s - waited_s)
        if connection.poll(pause_s):
            return
        waited_s += pause_s
        stopped = stopped + 1 if _is_stopped(process_id) else 0
        if stopped == LOOKS_BEFORE_WORDS:
            log.warning(
                "child process %d has been stopped from outside. Continue it with `kill -CONT %d`; "
                "otherwise it is ended in %.0f s and its work is done again.",
                process_id,
                process_id,
                (LOOKS_BEFORE_KILL - stopped) * LOOK_S,
            )
        if stopped == LOOKS_BEFORE_KILL:
            waited = f"{LOOKS_BEFORE_KILL * LOOK_S:.0f} s"
            raise ChildFailed("stopped", f"stopped from outside (SIGSTOP) for {waited}")
    raise ChildFailed("timeout_wall", f"no answer within {wall_s:.0f} s")


def _is_stopped(process_id: int) -> bool:
    """Return whether a process is stopped until it is continued; False without /proc."""
    try:
        line = Path(f"/proc/{process_id}/stat").read_text()
    except OSError:
        return False
    return line.rpartition(")")[2].split()[0] == "T"
