"""File locks, called claims: they tell processes in a shared folder which work is taken.

A claim is a lock on a small file. It ends with the process that holds it, however that ends, so
nothing has to be cleaned up after a kill. The file says who holds it, for those who wait. Claims
only avoid that work is done twice. Where a file system carries no locks, or none between machines,
two processes may make the same scene, of the same bytes. Correct files come from storage.atomic:
the first finished writer of a shard wins.
"""

import contextlib
import fcntl
import itertools
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from storage.atomic import write_error
from storage.remote.url import printable

log = logging.getLogger("trilight.file_locks")

_MOST_TRIES = 100
"""To create a lock in a folder that others delete."""

_SILENT_S = 10.0
"""Time until a wait is announced; it is again each time that it has become three times as long."""

_HOLDER_BYTES = 300
"""Most that is read of what a claim says of its holder."""

_unlocked = itertools.count()
"""Counts the locks that a file system refused to carry: the first one is a warning."""


@contextlib.contextmanager
def hold_lock(path: Path, *, wait: bool = False) -> Iterator[bool]:
    """Hold the lock of a file, a claim, for the block; yield whether it is ours.

    Args:
        path: the file of the claim; it is created here, and its holder may delete it.
        wait: until the claim is free, so that it always becomes ours.

    Raises:
        TrilightError: the folder cannot be written.
    """
    descriptor = _acquire_lock(path, wait)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            os.close(descriptor)


def open_lock(path: Path) -> int:
    """Return the descriptor of a lock's file, which is created where it is missing.

    Raises:
        TrilightError: the folder cannot be written.
    """
    tries = 0
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            return os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            # Another process may delete the folder between the two calls, or between the two looks
            # of mkdir. Some file systems say the same (ENOENT) of what can never be made.
            tries += 1
            vanished = isinstance(error, FileNotFoundError) or (
                isinstance(error, FileExistsError) and not path.parent.is_file()
            )
            if not vanished or tries == _MOST_TRIES:
                raise write_error(path, error) from error


def take_lock(descriptor: int, *, shared: bool = False, wait: bool = False) -> bool:
    """Take the lock of an open file; return whether it is ours.

    A file system that carries no locks grants every lock; the first time is a warning.

    Args:
        descriptor: of the file.
        shared: together with other shared locks; otherwise it excludes every other lock.
        wait: until it is free, so that it always becomes ours.
    """
    operation = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(descriptor, operation if wait else operation | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:  # ENOSYS, ENOLCK, EOPNOTSUPP, EIO: each system has its own
        if next(_unlocked) == 0:
            log.warning(
                "%s: the file system carries no locks (%s). Processes that work there at once may "
                "do the same work twice, with the same result; start one at a time.",
                printable(os.path.realpath(f"/proc/self/fd/{descriptor}")),
                error.strerror,
            )
    return True


def is_locked(path: Path) -> bool:
    """Return whether another holds a claim; to look, this takes a free one for a moment."""
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        return not take_lock(descriptor)
    finally:
        os.close(descriptor)


def describe_holder(path: Path) -> str:
    """Return who holds a claim and since when, as far as its file says."""
    try:
        host, process_id, since_s = _read_holder(path)
        since = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(int(since_s)))
        return f"process {int(process_id)} of {printable(host)}, at it since {since}"
    except (OSError, OverflowError, ValueError):  # as gmtime refuses
        return "another process"


class WaitNotice:
    """Logs the holder of a claim: first after `_SILENT_S`, then at ever longer intervals."""

    def __init__(self) -> None:
        """Begin the wait."""
        self._began_s = time.monotonic()
        self._next_s = _SILENT_S

    def update(self, claim: Path) -> None:
        """Log that the wait for the holder of a claim still lasts, if that is due."""
        waited_s = time.monotonic() - self._began_s
        if waited_s < self._next_s:
            return
        self._next_s = 3 * waited_s
        log.warning(
            "%s: waiting for %.0f s for %s. The work goes on when that process finishes or ends.",
            printable(str(claim)),
            waited_s,
            describe_holder(claim),
        )


def _acquire_lock(path: Path, wait: bool) -> int | None:
    """Return the descriptor that holds the lock, or None where another process holds it."""
    while True:
        descriptor = open_lock(path)
        if not take_lock(descriptor):
            if not wait:
                os.close(descriptor)
                return None
            with _announce_wait(path):
                take_lock(descriptor, wait=True)
        with contextlib.suppress(FileNotFoundError):  # its last owner deleted it while we waited
            if os.path.samestat(path.stat(), os.fstat(descriptor)):
                _write_holder(descriptor)
                return descriptor
        os.close(descriptor)


@contextlib.contextmanager
def _announce_wait(path: Path) -> Iterator[None]:
    """Announce from a thread how long the block waits for a claim."""
    notice = WaitNotice()
    ended = threading.Event()

    def announce() -> None:
        while not ended.wait(_SILENT_S / 4):
            if _read_holder(path)[:2] != _identity():  # a thread of ours ends by itself
                notice.update(path)

    threading.Thread(target=announce, daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _identity() -> list[str]:
    return [socket.gethostname(), str(os.getpid())]


def _write_holder(descriptor: int) -> None:
    text = " ".join([*_identity(), f"{time.time():.0f}"])
    with contextlib.suppress(OSError):  # a full disk: the claim is ours all the same
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, text.encode(), 0)


def _read_holder(path: Path) -> list[str]:
    """Return host, process and time of a claim's holder; nothing where the file does not say it."""
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb", buffering=0) as stream:
            return stream.read(_HOLDER_BYTES).decode(errors="replace").split(" ")
    return []
