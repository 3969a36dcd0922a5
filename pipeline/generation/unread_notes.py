"""Notes on parts of object files that no reader supports, for logs and terminals."""

import json
from collections.abc import Mapping
from pathlib import Path

from storage.atomic import write_atomically

UnreadNotes = Mapping[str, tuple[str, ...]]
"""Unread parts of an object's file, as short sentences by the uid of the object."""

_MOST_LINES = 5


def write_unread(logs: Path, unread: UnreadNotes, name: str = "unread") -> Path:
    """Write the sentences by uid to `NAME.json` of a folder; without any, delete the file."""
    path = logs / f"{name}.json"
    if unread:
        write_atomically(path, json.dumps(unread, indent=1, sort_keys=True).encode())
    else:
        path.unlink(missing_ok=True)
    return path


def format_unread(unread: UnreadNotes, path: Path) -> list[str]:
    """Return one line for each of the first objects, and the path that lists the others."""
    lines = [f"{uid}: {', '.join(unread[uid])}" for uid in sorted(unread)[:_MOST_LINES]]
    more = len(unread) - len(lines)
    return [*lines, *([f"and {more} more objects: {path}"] if more > 0 else [])]
