"""`objects.lock.jsonl`: which objects a dataset uses, frozen before its first scene."""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

from storage.atomic import write_atomically
from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.records.objects import LockedObject


def encode_objects_lock(objects: Iterable[LockedObject]) -> bytes:
    """Return the file of a lock: one line per object, sorted by uid."""
    rows = sorted(objects, key=lambda entry: entry.uid)
    return b"".join(canonical_json(dataclasses.asdict(row)) + b"\n" for row in rows)


def write_objects_lock(path: Path, objects: Iterable[LockedObject]) -> None:
    """Write the lock atomically."""
    write_atomically(path, encode_objects_lock(objects))


def read_objects_lock(path: Path) -> list[LockedObject]:
    """Return the objects of a lock.

    Raises:
        TrilightError: missing, or a line that is not a locked object.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise TrilightError(f"{path}: cannot be read ({error.strerror}).") from error
    return decode_objects_lock(data, str(path))


def decode_objects_lock(data: bytes, place: str) -> list[LockedObject]:
    """Return the objects of the bytes of a lock; raises as `read_objects_lock`, naming `place`."""
    objects = []
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            objects.append(LockedObject(**json.loads(line)))
        except (TypeError, ValueError) as error:
            raise TrilightError(f"{place}:{number}: not a locked object ({error}).") from error
    return objects
