"""The parts of files that no code has read, for logs and for people."""

import json
from collections.abc import Mapping
from pathlib import Path

from storage.atomic import write_atomically

Unread = Mapping[str, tuple[str, ...]]
"""Short sentences by the uid of an object."""

_MOST_LINES = 5


def write_unread(logs: Path, unread: Unread, name: str = "unread") -> Path:
    """Write `unread.json`, the sentences by uid; without any, remove an earlier one."""
    path = logs / f"{name}.json"
    if unread:
        write_atomically(path, json.dumps(unread, indent=1, sort_keys=True).encode())
    else:
        path.unlink(missing_ok=True)
    return path


def format_unread(unread: Unread, path: Path) -> list[str]:
    """Return a line for each of the first objects, and where the others stand."""
    lines = [f"{uid}: {', '.join(unread[uid])}" for uid in sorted(unread)[:_MOST_LINES]]
    more = len(unread) - len(lines)
    return [*lines, *([f"and {more} more objects: {path}"] if more > 0 else [])]
