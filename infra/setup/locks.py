"""Lock files: exact versions, with the sha256 of every file that may be installed."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

_PACKAGE = re.compile(r"(?P<name>[A-Za-z0-9._-]+)==(?P<version>[^\s;\\]+)")
_DIGEST = re.compile(r"--hash=sha256:([0-9a-f]{64})")


@dataclass(frozen=True, kw_only=True)
class LockedPackage:
    """Package of a lock file."""

    name: str
    """Name in the lock's spelling."""
    version: str
    """Version without a build tag such as +cpu."""
    sha256: tuple[str, ...]
    """Sorted digests of the files that may be installed."""


def read_lock(path: Path) -> list[LockedPackage]:
    """Return the packages of a lock; raises ValueError for any other line but a comment."""
    rows = []
    for line in path.read_text().replace("\\\n", " ").splitlines():
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        match = _PACKAGE.match(line)
        if match is None:
            raise ValueError(f"{path.name}: {line[:80]!r} is no NAME==VERSION; run `make lock`.")
        digests = tuple(sorted(_DIGEST.findall(line)))
        rows.append(LockedPackage(name=match["name"], version=match["version"], sha256=digests))
    return rows


def write_lock(path: Path, rows: Iterable[LockedPackage]) -> None:
    """Write a lock in pip's format, one digest a line."""
    entries = (
        " \\\n    ".join(
            [f"{row.name}=={row.version}", *(f"--hash=sha256:{digest}" for digest in row.sha256)]
        )
        for row in rows
    )
    path.write_text("\n".join(entries) + "\n")
