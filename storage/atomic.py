"""Files that appear whole or not at all: temporary name, fsync, rename."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from storage.errors import TrilightError

TEMPORARY_SUFFIX = ".part"


@contextlib.contextmanager
def atomic_writer(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears under its name only when the block ends without an error.

    A process that is killed inside the block leaves at most a `.part` file, which the next writer
    of the same name in the same process id, or `remove_leftovers`, clears away. Two writers of the
    same name do no harm: each has a temporary name of its own, and the last rename wins.

    Raises:
        TrilightError: the disk is full, or the place cannot be written.
    """
    temporary = path.with_name(f"{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` so that `path` holds either all of it or what it held before."""
    with atomic_writer(path) as stream:
        stream.write(data)


def remove_leftovers(folder: Path) -> None:
    """Delete what killed writers left below `folder`. Call only while holding its lock."""
    for leftover in folder.rglob(f"*{TEMPORARY_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def write_error(path: Path, error: OSError) -> TrilightError:
    """Return the user's view of a failed write."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return TrilightError(
            f"{path.parent}: the disk is full. What was finished is safe: free some space and run "
            "the same command again."
        )
    return TrilightError(
        f"{path.parent}: cannot write {path.name} ({error.strerror}). What was finished is safe: "
        "choose a writable folder or mend its permissions, and run the same command again."
    )


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
