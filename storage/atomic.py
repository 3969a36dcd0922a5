"""Files that appear whole or not at all (temporary name, fsync, rename), and logs of lines."""

import contextlib
import errno
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from storage.cache import cache_folder
from storage.errors import EnvironmentFailure, TrilightError

TEMPORARY_SUFFIX = ".part"
_MAY_PASS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ESTALE, errno.ENOMEM, errno.EMFILE)
_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)


@contextlib.contextmanager
def atomic_writer(path: Path, *, replace: bool = True) -> Iterator[BinaryIO]:
    """Open a file that appears under its name only when the block ends without an error.

    A process that is killed inside the block leaves at most a `.part` file, which
    `remove_leftovers` clears away. Two writers of the same name do no harm, on one machine or on
    two: each has a temporary name of its own.

    Args:
        path: the final name.
        replace: the last writer wins; otherwise the first, and the others' bytes are dropped.

    Raises:
        TrilightError: the disk is full (an EnvironmentFailure), or the place cannot be written.
    """
    # containers give all their processes number 1
    unique_suffix = f"{os.getpid()}-{os.urandom(4).hex()}"
    temporary = path.with_name(f"{path.name}.{unique_suffix}{TEMPORARY_SUFFIX}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        if replace:
            os.replace(temporary, path)
        else:
            _appear_first(temporary, path)
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


def append_line(path: Path, line: str, *, durable: bool = False) -> None:
    """Append a line to a file, whose folder may be missing.

    Args:
        path: the file.
        line: text without a line break.
        durable: of a file with one writer, drop a last line that a kill has cut, and return only
            when the new line is on the disk.

    Raises:
        TrilightError: the disk is full or the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+" if durable else "ab") as stream:
            if durable and stream.seek(0, os.SEEK_END):
                stream.seek(-1, os.SEEK_END)
                if stream.read() != b"\n":
                    stream.seek(0)
                    stream.truncate(stream.read().rfind(b"\n") + 1)
            stream.write(line.encode() + b"\n")
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
    except OSError as error:
        raise write_error(path, error) from error


def remove_leftovers(folder: Path, *, older_than_s: float = 0.0) -> None:
    """Delete what killed writers left below `folder`. Call only while holding its lock.

    Args:
        folder: where to look, however deep.
        older_than_s: files that were written to more recently stay; for locks that may not reach
            every machine that writes there.
    """
    for place, _, names in os.walk(folder):  # a third of the time of rglob, of a million files
        for name in filter(lambda name: name.endswith(TEMPORARY_SUFFIX), names):
            leftover = Path(place, name)
            with contextlib.suppress(OSError):  # its writer has just finished, or it is not ours
                if time.time() - leftover.stat().st_mtime >= older_than_s:
                    leftover.unlink()


def write_error(path: Path, error: OSError) -> TrilightError:
    """Return the user's view of a failed write."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return EnvironmentFailure(
            f"{path.parent}: the disk is full. What was finished is safe: free some space and run "
            "the same command again."
        )
    kind = EnvironmentFailure if error.errno in _MAY_PASS else TrilightError
    step = "choose"
    with contextlib.suppress(TrilightError):  # there may be no cache
        step = "set TRILIGHT_CACHE to" if path.is_relative_to(cache_folder("")) else step
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        place = next(above for above in path.parents if above.exists())
        if not place.is_dir():
            return TrilightError(f"{place} is a file; expected a folder: {step} another place.")
    return kind(
        f"{path.parent}: cannot write {path.name} ({error.strerror}). What was finished is safe: "
        f"{step} a writable folder or fix its permissions, and run the same command again."
    )


def _appear_first(temporary: Path, path: Path) -> None:
    """Give a file its final name unless that is taken."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        pass
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        if not path.exists():  # a file system without links: nearly as good
            os.replace(temporary, path)


def _sync_folder(folder: Path) -> None:
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except FileNotFoundError:  # another maker of the shard has packed it, and cleared its folder
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
