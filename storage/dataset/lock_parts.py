"""The lock of a dataset whose objects are frozen in parts: the rows of all parts, sorted by uid."""

import contextlib
import json
from collections.abc import Iterable

from storage.dataset.layout import DatasetFolder
from storage.errors import TrilightError


def known_lock(folder: DatasetFolder) -> bytes:
    """Return the lock of a dataset's folder; of one that is not finished, of its parts so far."""
    parts = [path.read_bytes() for path in folder.lock_parts()]
    with contextlib.suppress(FileNotFoundError):
        parts.append(folder.objects_lock.read_bytes())
    return joined_lock(parts)


def joined_lock(files: Iterable[bytes]) -> bytes:
    """Return the lock that some files of rows make together; equal rows stay single.

    Raises:
        TrilightError: a line is no row, or an object has two different ones.
    """
    rows: dict[str, bytes] = {}
    for file in files:
        for line in file.splitlines(keepends=True):
            uid = _uid(line)
            if rows.setdefault(uid, line) != line:
                raise TrilightError(
                    f"objects.lock.jsonl: {uid!r} was frozen twice, and not as the same object; "
                    "expected makers with the same objects, textures and skies. Choose another "
                    "--out."
                )
    return b"".join(rows[uid] for uid in sorted(rows))


def _uid(line: bytes) -> str:
    try:
        return str(json.loads(line)["uid"])
    except (KeyError, TypeError, ValueError) as error:
        raise TrilightError(
            f"objects.lock.jsonl: a line of a part is not a locked object ({error}); expected the "
            "files of .staging/object_locks as they were frozen. Restore them."
        ) from error
