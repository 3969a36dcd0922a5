"""Processor time of some work, and the part of it during which Python's lock is held.

Several threads share one lock, so that part and not the number of cores ends what threads can do.
CPython keeps the lock's state beside its switch interval: the work runs in a child that sets the
interval to numbers which nobody else has there, and the parent looks at the state while it runs, a
thousand times a second. A thread that waits for a core waits with the lock as often as without it,
so the share is right on busy machines too.
"""

import ctypes
import multiprocessing
import os
import struct
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from infra.bench.experiment import Figures

Prepare = Callable[..., Callable[[], int]]
"""Gets ready in the child, unmeasured; what it returns does the work, and counts it."""

_SIGNS_US = (4321, 7713)
_SEARCHED_BYTES = 6144
_LOCKED_AFTER = 16
"""Bytes from the interval to the flag: between them is who held the lock last."""
_PAUSE_S = 0.001
_PATIENCE_S = 900.0


def with_lock_time(prepare: Prepare, *arguments: object) -> Figures:
    """Return core-seconds and seconds under the lock for each unit of work.

    Args:
        prepare: of a module's top level.
        arguments: what it is given.

    Returns:
        `core_s`, and `lock_s` where this Python tells it; right where one thread works at a time.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    child = context.Process(target=_work, args=(theirs, prepare, arguments), daemon=True)
    child.start()
    theirs.close()
    try:
        place = ours.recv()
        ours.send("begin")
        share = _share_locked(child.pid, place, ours)
        count, core_s = ours.recv()
    finally:
        child.join(_PATIENCE_S)
    figures = {"core_s": core_s / count}
    return figures if share is None else {**figures, "lock_s": share * core_s / count}


def _work(link: Connection, prepare: Prepare, arguments: tuple[object, ...]) -> None:
    work = prepare(*arguments)
    link.send(_place_of_lock())
    link.recv()
    began = time.process_time()
    count = work()
    link.send((count, time.process_time() - began))


def _place_of_lock() -> int | None:
    """Return the address of the flag in this process; None where it is not found."""
    before = sys.getswitchinterval()
    runtime = ctypes.addressof(ctypes.c_char.in_dll(ctypes.pythonapi, "_PyRuntime"))
    places: set[int] | None = None
    try:
        for sign in _SIGNS_US:
            sys.setswitchinterval(sign / 1e6)
            words = struct.iter_unpack("Q", ctypes.string_at(runtime, _SEARCHED_BYTES))
            found = {row for row, (word,) in enumerate(words) if word == sign}
            places = found if places is None else places & found
    finally:
        sys.setswitchinterval(before)
    if places is None or len(places) != 1:
        return None
    return runtime + 8 * places.pop() + _LOCKED_AFTER


def _share_locked(process: int | None, place: int | None, link: Connection) -> float | None:
    """Return how often the lock is held until the child says something."""
    memory = Path(f"/proc/{process}/mem")
    if place is None or not memory.exists():
        return None
    looked = held = 0
    descriptor = os.open(memory, os.O_RDONLY)
    try:
        while not link.poll(_PAUSE_S):
            (locked,) = struct.unpack("i", os.pread(descriptor, 4, place))
            looked, held = looked + 1, held + (locked != 0)
    finally:
        os.close(descriptor)
    return held / looked if looked else None
