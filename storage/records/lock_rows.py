"""Rows of `objects.lock.jsonl`, read where one is wanted: a lock may list millions."""

import os
from collections.abc import Iterator
from pathlib import Path

from storage.errors import TrilightError
from storage.records.objects import LockedObject
from storage.records.safe_read import open_plain
from storage.typed_json import read_json


class LockRows:
    """The rows of a lock file; what it holds in memory does not depend on how many there are."""

    def __init__(self, path: Path) -> None:
        """Open the lock.

        Raises:
            TrilightError: it is missing, or no plain file.
        """
        self._path = path
        try:
            self._stream = open_plain(path)
        except OSError as error:
            raise TrilightError(f"{path}: cannot be read ({error.strerror}).") from error

    @property
    def num_bytes(self) -> int:
        """Size of the file."""
        return os.fstat(self._stream.fileno()).st_size

    def at(self, offset: int) -> LockedObject:
        """Return the row that begins at a byte; raises TrilightError where none does."""
        self._stream.seek(offset)
        return self._row(self._stream.readline(), offset)

    def find(self, uid: str) -> LockedObject | None:
        """Return the row of a uid, or None: rows are sorted, so about 20 of a million are read."""
        low = 0
        high = self.num_bytes
        while low < high:
            start = self._start_of_row((low + high) // 2, low)
            self._stream.seek(start)
            line = self._stream.readline()
            row = self._row(line, start)
            if row.uid == uid:
                return row
            if row.uid < uid:
                low = start + len(line)
            else:
                high = start
        return None

    def __iter__(self) -> Iterator[LockedObject]:
        """Yield all rows, sorted by uid."""
        offset = 0
        while offset < self.num_bytes:
            self._stream.seek(offset)
            line = self._stream.readline()
            yield self._row(line, offset)
            offset += len(line)

    def _start_of_row(self, position: int, low: int) -> int:
        """Return where the row of a byte begins; `low` is the beginning of some row before it."""
        step = 1024
        while position > low:
            start = max(low, position - step)
            self._stream.seek(start)
            cut = self._stream.read(position - start).rfind(b"\n")
            if cut >= 0:
                return start + cut + 1
            step = 2 * step
            position = start
        return low

    def _row(self, line: bytes, offset: int) -> LockedObject:
        place = f"{self._path}: row at byte {offset}"
        return read_json(line, LockedObject, place)
