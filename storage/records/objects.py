"""Rows that stages hand on: objects with their rights, the lock of a dataset, and rejections.

`objects.lock.jsonl` lists the objects of a dataset and is frozen before its first scene.
`failures.jsonl` lists every object, scene and view that was rejected, with its reason.
"""

import dataclasses
import functools
import mmap
import os
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from storage.atomic import write_atomically
from storage.digests import canonical_json
from storage.errors import Rejected
from storage.records.safe_read import name_unreadable, open_plain, read_plain
from storage.typed_json import read_json, read_json_lines


@dataclass(frozen=True, kw_only=True)
class NamedObject:
    """Identity and rights of an object, which every row about it states."""

    uid: str
    """Unique in its source, and stable: it names the object in every later record."""
    title: str
    """Name as documents and pages show it."""
    licence: str
    """SPDX identifier of the license, or `LicenseRef-...`."""
    licence_source: str
    """Where the licence is stated, and as of when; for the record of rights."""
    attribution: str
    """Author to credit, as the source states it."""
    source_url: str

    @property
    def identity(self) -> dict[str, str]:
        """Identity and rights as keywords, for another row about this object."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(NamedObject)}

    @property
    def rights(self) -> dict[str, str]:
        """Rights as keywords, for a record of a scene that shows this object."""
        return {name: getattr(self, name) for name in ("licence", "attribution", "source_url")}


@dataclass(frozen=True, kw_only=True)
class ObjectRecord(NamedObject):
    """One 3D object as it was found: a readable file and the rights to it."""

    path: str
    """The file, absolute, on this machine; never published."""
    root: str = ""
    """Folder in which its pictures may lie anywhere; its own one where empty. Never published."""


OBJECT = "object"
TEXTURE = "texture"
SKY = "sky"
"""Kinds of rows of a lock: objects, and what users bring for surfaces and for light."""


@dataclass(frozen=True, kw_only=True)
class LockedObject(NamedObject):
    """One accepted object, texture or sky of a dataset, as `objects.lock.jsonl` freezes it."""

    asset_sha256: str
    """Digest of the prepared file: the exact triangles or texels that scenes use."""
    split: str
    """train, validation or test, by a hash of the cleaned geometry, of a texture's base colour or
    of a map: copies stay together."""
    kind: str = OBJECT
    """object, texture or sky; only the latter two are written."""


EMITTER = "emitter"
"""Kind of a scene's objects that emit, parts of objects among them."""


def locked_uids(objects: Iterable[tuple[str, str]], provenance: Mapping[str, Any]) -> list[str]:
    """Return the uids of all that a scene has of a lock, sorted: objects, textures and a map.

    Args:
        objects: kind and uid of each row of the scene's objects; floors and lamps are in none, what
            an object emits is of that.
        provenance: of the scene, perhaps from outside; what `maps` says counts where it is text.
    """
    maps = provenance.get("maps", ())
    map_uids = (
        [uid for uid in maps if isinstance(uid, str)] if isinstance(maps, list | tuple) else []
    )
    parts = (uid for kind, uid in objects if kind == OBJECT or (kind == EMITTER and uid))
    return sorted({*parts, *map_uids})


@dataclass(frozen=True, kw_only=True)
class Failure:
    """One row of `failures.jsonl`: what was rejected, where, and why."""

    stage: str
    """objects, assets, scenes or renders."""
    item: str
    """uid of the object or key of the scene (with `.view` where a view was rejected)."""
    reason: str
    """Stable reason code in snake_case."""
    message: str
    attempt: int = 0
    """Number of the attempt at the item, from 0."""


def failure_of(stage: str, item: str, rejection: Rejected, attempt: int = 0) -> Failure:
    """Return the row of a rejection."""
    return Failure(
        stage=stage, item=item, reason=rejection.reason, message=rejection.message, attempt=attempt
    )


def encode_objects_lock(objects: Iterable[LockedObject]) -> bytes:
    """Return the file of a lock: one line per object, sorted by uid."""
    rows = sorted(objects, key=lambda entry: entry.uid)
    return _lines(rows)


def write_objects_lock(path: Path, objects: Iterable[LockedObject]) -> None:
    """Write the lock atomically."""
    write_atomically(path, encode_objects_lock(objects))


def read_objects_lock(path: Path) -> list[LockedObject]:
    """Return the objects of a lock.

    Raises:
        TrilightError: missing, or a line that is not a locked object.
    """
    with name_unreadable(path):
        return read_json_lines(read_plain(path), LockedObject, str(path))


def encode_failures(failures: Iterable[Failure]) -> bytes:
    """Return one line per failure, each once, sorted by stage, item and attempt."""
    rows = sorted(set(failures), key=lambda row: (row.stage, row.item, row.attempt, row.reason))
    return _lines(rows)


def decode_failures(data: bytes) -> list[Failure]:
    """Return the failures of a file that `encode_failures` made.

    Raises:
        TrilightError: a line is not a failure.
    """
    return read_json_lines(data, Failure, "failures.jsonl")


def read_failures(path: Path) -> list[Failure]:
    """Return the failures of a file; none where there is no file."""
    return decode_failures(read_plain(path)) if path.exists() else []


def write_failures(path: Path, failures: Iterable[Failure]) -> None:
    """Write the failures atomically."""
    write_atomically(path, encode_failures(failures))


def count_by_reason(failures: Iterable[Failure]) -> list[tuple[str, str, int]]:
    """Return (stage, reason, how many), the most frequent first; equal rows are one."""
    rows = dict.fromkeys(failures)
    counts = Counter((failure.stage, failure.reason) for failure in rows)
    return [(stage, reason, count) for (stage, reason), count in counts.most_common()]


def _lines(rows: Iterable[LockedObject | Failure]) -> bytes:
    return b"".join(canonical_json(_record(row)) + b"\n" for row in rows)


def _record(row: LockedObject | Failure) -> dict[str, Any]:
    """Return a row as JSON values; locks of objects alone know no kinds, as before.

    Lone surrogates, which texts from outside may hold and UTF-8 does not, become `?`.
    """
    return {
        name: value.encode(errors="replace").decode() if isinstance(value, str) else value
        for name, value in dataclasses.asdict(row).items()
        if (name, value) != ("kind", OBJECT)
    }


class LockRows:
    """The rows of a lock file, which is mapped: memory does not depend on how many there are."""

    def __init__(self, path: Path) -> None:
        """Open the lock.

        Raises:
            TrilightError: it is missing, or no plain file.
        """
        self._path = path
        self._lines: mmap.mmap | bytes = b""
        with name_unreadable(path), open_plain(path) as stream:
            if os.fstat(stream.fileno()).st_size:  # nothing cannot be mapped
                self._lines = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)

    @property
    def num_bytes(self) -> int:
        """Size of the file."""
        return len(self._lines)

    def at(self, offset: int) -> LockedObject:
        """Return the row that begins at a byte; raises TrilightError where none does."""
        line = self._lines[offset : self._end(offset)]
        return read_json(line, LockedObject, f"{self._path}: row at byte {offset}")

    def find(self, uid: str) -> LockedObject | None:
        """Return the row of a uid, or None: rows are sorted, so about 20 of a million are read."""
        row_at = functools.cache(self.at)
        start = bisect_left(
            range(self.num_bytes),
            uid,
            key=lambda byte: row_at(self._lines.rfind(b"\n", 0, byte) + 1).uid,
        )
        row = row_at(start) if start < self.num_bytes else None
        return row if row and row.uid == uid else None

    def __iter__(self) -> Iterator[tuple[int, LockedObject]]:
        """Yield the first byte of each row and the row, sorted by uid."""
        offset = 0
        while offset < self.num_bytes:
            yield offset, self.at(offset)
            offset = self._end(offset)

    def _end(self, offset: int) -> int:
        """Return where the row of a byte ends, behind its line break."""
        return self._lines.find(b"\n", offset) + 1 or self.num_bytes
