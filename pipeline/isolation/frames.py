"""Messages between a child and its owner: eight bytes with the length, then so many bytes.

The owner waits for each piece within the time of one call, so that a child that says half a
message, or reads none, holds it no longer than one that says nothing.
"""

import os
import select
from collections.abc import Callable, Iterable

import numpy as np

from pipeline.isolation.waiting import CallTime

_LENGTH = 8

Wait = Callable[[int, int], None]
"""Returns when a file can be read or written: its number and the event of `select.poll`."""


class TooLong(Exception):
    """A message claims to be longer than the memory that a child may have."""


def wait_forever(file: int, event: int) -> None:
    """Return at once: reading and writing a file that blocks waits by itself."""


def patient(patience: CallTime) -> Wait:
    """Return how an owner waits, whose files do not block; raises as `CallTime.until`."""

    def wait(file: int, event: int) -> None:
        poll = select.poll()
        poll.register(file, event)
        patience.until(lambda pause_s: bool(poll.poll(pause_s * 1000)))

    return wait


def send(file: int, parts: Iterable[bytes | memoryview], wait: Wait) -> None:
    """Write one message; OSError where nobody reads it any more."""
    views = [memoryview(part) for part in parts]
    length = sum(len(view) for view in views)
    for view in (memoryview(length.to_bytes(_LENGTH, "little")), *views):
        while view:
            wait(file, select.POLLOUT)
            view = view[os.write(file, view) :]


def receive(file: int, wait: Wait, most: int) -> memoryview:
    """Return one message.

    Args:
        file: number of the open file.
        wait: how to.
        most: bytes that it may have.

    Raises:
        EOFError: the other side has ended.
        TooLong: it claims to have more bytes.
    """
    length = int.from_bytes(_exactly(file, _LENGTH, wait), "little")
    if length > most:
        raise TooLong(f"{length} bytes; expected at most {most}")
    return _exactly(file, length, wait)


def _exactly(file: int, count: int, wait: Wait) -> memoryview:
    whole = np.zeros(count, np.uint8).data  # which takes memory only as it is filled
    rest = whole
    while rest:
        wait(file, select.POLLIN)
        read = os.readv(file, [rest])
        if not read:
            raise EOFError
        rest = rest[read:]
    return whole
