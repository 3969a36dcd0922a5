"""Names of files as uids of objects."""

from collections.abc import Iterable

from pipeline.objects.listing import failure
from storage.records.objects import Failure
from storage.remote.safe_url import printable

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
"""Of the files that are objects; compared in lower case."""


def is_object_file(name: str) -> bool:
    """Say whether a path names an object and none of its parts is hidden."""
    return name.lower().endswith(SUFFIXES) and not any(
        part.startswith(".") for part in name.split("/")
    )


def assign_uids(names: Iterable[str]) -> tuple[dict[str, str], list[Failure]]:
    """Return the uid of every file, and a failure for each that can have none of its own.

    The uid is the path within the folder, made printable, without its suffixes: `banner.gltf.glb`
    is `banner`. Where that is taken, by the order of the names, it is the full name: of `a.obj` and
    `a.stl`, `a` and `a.stl`. So a new file may take the uid of an older one that differs in its
    suffix only; a catalogue keeps uids fixed. Two names that print alike (a line break, and a
    backslash with an n) cannot both be told from outside: the later one fails.
    """
    uids: dict[str, str] = {}
    failures = []
    taken: set[str] = set()
    for name in sorted(names):
        full = printable(name)
        short = _without_suffixes(full)
        uid = full if short in taken or not short.rpartition("/")[2].strip() else short
        if uid in taken:
            message = "another file has a name that prints alike; rename one of them"
            failures.append(failure(uid, "name_clash", message))
            continue
        taken.add(uid)
        uids[name] = uid
    return uids, failures


def _without_suffixes(name: str) -> str:
    while name.lower().endswith(SUFFIXES):
        name = name[: name.rindex(".")]
    return name
