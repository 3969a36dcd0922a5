"""`SHA256SUMS` of a published folder, in the format of `sha256sum -c`.

Code that rewrites documents renews their lines. Lines of shards stay: a shard that is damaged later
must not get a new sum.
"""

from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from types import MappingProxyType

from storage.atomic import write_atomically
from storage.digests import sha256_of_file
from storage.errors import TrilightError

SUMS = "SHA256SUMS"

UNPUBLISHED = ("logs/*", ".staging/*", ".cache/*", "*.claim", "*.part", "*.tmp")
"""Patterns of files that are never published: logs, claims and unfinished files."""

_SHARD = ".tar"


def published_files(folder: Path) -> dict[str, Path]:
    """Return the files of a folder that are published, in order, by their names below it."""
    every = sorted(path for path in folder.rglob("*") if path.is_file())
    names = {path.relative_to(folder).as_posix(): path for path in every}
    return {
        name: path
        for name, path in names.items()
        if not any(fnmatch(name, pattern) for pattern in UNPUBLISHED)
    }


def write_sums(folder: Path, known: Mapping[str, str] = MappingProxyType({})) -> None:
    """Write the sums of all published files; raises TrilightError if they cannot be written.

    Args:
        known: sums by name, which are not computed again.
    """
    lines = [
        f"{known.get(name) or sha256_of_file(path)}  {name}\n"
        for name, path in published_files(folder).items()
        if name != SUMS
    ]
    write_atomically(folder / SUMS, "".join(lines).encode())


def renew_sums(folder: Path) -> None:
    """Write existing sums again, except those of shards, which stay as they are.

    Raises:
        TrilightError: the file cannot be written, or is malformed.
    """
    if (folder / SUMS).is_file():
        known = _read(folder)
        write_sums(folder, {name: known[name] for name in known if name.endswith(_SHARD)})


def stale_sums(folder: Path) -> list[str]:
    """Return the files, without shards, that differ from the sums; empty without sums.

    Raises:
        TrilightError: the file of sums is malformed.
    """
    if not (folder / SUMS).is_file():
        return []
    known = _read(folder)
    files = published_files(folder)
    return sorted(
        name
        for name in known.keys() | files.keys() - {SUMS}
        if name not in known
        or name not in files
        or (not name.endswith(_SHARD) and sha256_of_file(files[name]) != known[name])
    )


def _read(folder: Path) -> dict[str, str]:
    sums = {}
    for line in (folder / SUMS).read_text(errors="replace").splitlines():
        sha256, separator, name = line.partition("  ")
        if not separator or len(sha256) != 64:
            raise TrilightError(
                f"{folder / SUMS}: {line:.40} is no sum; expected lines of `sha256sum`. Delete the "
                "file, and write it again with make release."
            )
        sums[name] = sha256
    return sums
