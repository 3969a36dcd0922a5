"""The parts of files that no code has read, for logs and for people."""

from collections.abc import Mapping
from pathlib import Path

from storage.atomic import write_atomically
from storage.digests import canonical_json

Unread = Mapping[str, tuple[str, ...]]
"""Short sentences by the uid of an object."""

_MOST_LINES = 5


def write_unread(logs: Path, unread: Unread) -> Path:
    """Write `unread.jsonl`, a line per object; without any, remove an earlier one."""
    path = logs / "unread.jsonl"
    rows = [canonical_json({"item": uid, "unread": unread[uid]}) + b"\n" for uid in sorted(unread)]
    if rows:
        write_atomically(path, b"".join(rows))
    else:
        path.unlink(missing_ok=True)
    return path


def unread_lines(unread: Unread, path: Path) -> list[str]:
    """Return a line for each of the first objects, and where the others stand."""
    lines = [f"{uid}: {', '.join(unread[uid])}" for uid in sorted(unread)[:_MOST_LINES]]
    more = len(unread) - len(lines)
    return [*lines, *([f"and {more} more objects: {path}"] if more > 0 else [])]
