"""Training as a process of this machine, with what it cost."""

import resource
import subprocess
import sys
from collections.abc import Callable

from infra.train_order import TrainOrder
from storage.errors import TrilightError


def train_here(order: TrainOrder, *, quiet: bool = False) -> float:
    """Train as `trilight train` does, and return its core-seconds; `quiet` keeps stdout empty.

    Raises:
        TrilightError: it did not end well; what it saved is safe.
    """

    def run() -> None:
        status = subprocess.run(
            order.command(), check=False, stdout=sys.stderr if quiet else None
        ).returncode
        if status:
            raise TrilightError(
                f"train {order.run} ended with status {status}; the same command goes on from its "
                "last checkpoint."
            )

    return core_s_of(run)


def core_s_of(run: Callable[[], None]) -> float:
    """Return the core-seconds of the processes that a call starts and waits for."""
    before = _of_children()
    run()
    return _of_children() - before


def _of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
