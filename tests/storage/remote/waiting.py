"""Waiting for what other processes do."""

import time
from collections.abc import Callable


def until(happened: Callable[[], object]) -> None:
    """Return when something has happened; the test's own time limit ends it otherwise."""
    while not happened():
        time.sleep(0.02)
