"""Sends and receives messages between a child and its owner: parts, after their number and lengths.

The owner waits for each piece within the time limit of one call, so that a child that sends half a
message, or reads none, blocks it no longer than a silent one.
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
"""Waits until a file can be read or written: takes its number and an event of `select.poll`."""


class TooLong(Exception):
    """A message claims to be longer than the memory that a child may have."""


def wait_forever(file: int, event: int) -> None:
    """Return at once: reads and writes of a blocking file wait by themselves."""


def wait_within(patience: CallTime) -> Wait:
    """Return a wait function for files that do not block; raises as `CallTime.until`."""

    def wait(file: int, event: int) -> None:
        poll = select.poll()
        poll.register(file, event)
        patience.until(lambda pause_s: bool(poll.poll(pause_s * 1000)))

    return wait


def send(file: int, parts: Sequence[bytes | memoryview], wait: Wait) -> None:
    """Write one message; raises OSError if the other side has ended."""
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
        wait: waits until the file can be read.
        most: most bytes of all parts together.

    Raises:
        EOFError: the other side has ended.
        TooLong: the message claims more bytes, or more parts than `MOST_PARTS`.
        MemoryError: this process has no memory for it.
    """
    (count,) = _receive_bytes(file, _LENGTH.itemsize, wait).view(_LENGTH).tolist()
    if count > MOST_PARTS:
        raise TooLong(f"{count} parts; expected at most {MOST_PARTS}")
    lengths = _receive_bytes(file, count * _LENGTH.itemsize, wait).view(_LENGTH).tolist()
    if sum(lengths) > most:
        raise TooLong(f"{sum(lengths)} bytes; expected at most {most}")
    return [_receive_bytes(file, length, wait) for length in lengths]


def _receive_bytes(file: int, count: int, wait: Wait) -> NDArray[np.uint8]:
    data = np.zeros(count, np.uint8)  # lazy: memory is used only as it is filled
    rest = data.data
    while rest:
        wait(file, select.POLLIN)
        read = os.readv(file, [rest])
        if not read:
            raise EOFError
        rest = rest[read:]
    return data
