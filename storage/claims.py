"""Claims: locks that tell processes in a shared folder which work is taken.

A claim is a lock on a small file. It ends with the process that holds it, however that ends, so
nothing has to be cleaned up after a kill. Claims only avoid that work is done twice. Where a file
system does not carry locks between machines, two of them may make the same scene, of the same
bytes. Correct files come from storage.atomic: the first finished writer of a shard wins.
"""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from storage.atomic import write_error

_MOST_TRIES = 100
"""To create a lock in a folder that others delete."""


@contextlib.contextmanager
def claimed(path: Path, *, wait: bool = False) -> Iterator[bool]:
    """Hold a claim for the block; yield whether it is ours.

    Args:
        path: the file of the claim; it is created here, and its holder may delete it.
        wait: until the claim is free, so that it always becomes ours.

    Raises:
        TrilightError: the folder cannot be written.
    """
    descriptor = _locked(path, wait)
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


def flock_now(descriptor: int) -> bool:
    """Take an exclusive lock without waiting; return whether it is ours."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _locked(path: Path, wait: bool) -> int | None:
    """Return the descriptor that holds the lock, or None where another process holds it."""
    while True:
        descriptor = open_lock(path)
        if wait:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        elif not flock_now(descriptor):
            os.close(descriptor)
            return None
        if _is(path, descriptor):
            return descriptor
        os.close(descriptor)  # its last owner deleted it while we waited


def _is(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
