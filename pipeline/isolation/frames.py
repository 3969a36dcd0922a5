"""Messages between a child and its owner: parts, whose number and lengths stand before them.

The owner waits for each piece within the time of one call, so that a child that says half a
message, or reads none, holds it no longer than one that says nothing.
"""

import os
import select
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.isolation.waiting import CallTime

_LENGTH = np.dtype("<u8")
MOST_PARTS = 1 << 17

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


def send(file: int, parts: Sequence[bytes | memoryview], wait: Wait) -> None:
    """Write one message; OSError where nobody reads it any more."""
    table = np.array([len(parts), *map(len, parts)], _LENGTH).tobytes()
    for part in (table, *parts):
        view = memoryview(part)
        while view:
            wait(file, select.POLLOUT)
            view = view[os.write(file, view) :]


def receive(file: int, wait: Wait, most: int) -> list[NDArray[np.uint8]]:
    """Return the parts of one message, each in memory of its own.

    Args:
        file: number of the open file.
        wait: how to.
        most: bytes that all parts may have.

    Raises:
        EOFError: the other side has ended.
        TooLong: it claims to have more bytes, or more than `MOST_PARTS`.
        MemoryError: this process has no room for it.
    """
    (count,) = _exactly(file, _LENGTH.itemsize, wait).view(_LENGTH).tolist()
    if count > MOST_PARTS:
        raise TooLong(f"{count} parts; expected at most {MOST_PARTS}")
    lengths = _exactly(file, count * _LENGTH.itemsize, wait).view(_LENGTH).tolist()
    if sum(lengths) > most:
        raise TooLong(f"{sum(lengths)} bytes; expected at most {most}")
    return [_exactly(file, length, wait) for length in lengths]


def _exactly(file: int, count: int, wait: Wait) -> NDArray[np.uint8]:
    whole = np.zeros(count, np.uint8)  # which takes memory only as it is filled
    rest = whole.data
    while rest:
        wait(file, select.POLLIN)
        read = os.readv(file, [rest])
        if not read:
            raise EOFError
        rest = rest[read:]
    return whole
