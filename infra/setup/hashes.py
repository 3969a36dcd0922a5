"""Adds to a lock file the sha256 of every file that a package index offers for its versions.

`pip-compile --generate-hashes` queries one index by name; if that fails, it downloads every file of
every release to compute digests that each index states anyway. This script queries the indices of
pip's configuration, and computes only the digests of local files. Files for other systems are
included, so that one lock serves all.

    python -m infra.setup.hashes requirements/all.txt ...
"""

import hashlib
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from infra.setup.locks import LockedPackage, read_lock, write_lock

_AT_ONCE = 8


def main(paths: list[Path]) -> None:
    """Write the locks again with the digests of each package; raises ValueError if one has none."""
    from piptools.repositories import PyPIRepository

    locks = {path: read_lock(path) for path in paths}
    pins = sorted({(row.name, row.version) for rows in locks.values() for row in rows})
    with TemporaryDirectory() as cache:
        repository = PyPIRepository([], cache_dir=cache)
        with repository.allow_all_wheels(), ThreadPoolExecutor(_AT_ONCE) as threads:
            digests = threads.map(lambda pin: _digests(repository, *pin), pins)
            by_pin = dict(zip(pins, digests, strict=True))
    for path, rows in locks.items():
        hashed = [
            LockedPackage(name=row.name, version=row.version, sha256=by_pin[row.name, row.version])
            for row in rows
        ]
        write_lock(path, hashed)


def _digests(repository: Any, name: str, version: str) -> tuple[str, ...]:
    digests = {
        digest
        for candidate in repository.find_all_candidates(name)
        if str(candidate.version).partition("+")[0] == version  # both as packaging writes them
        for digest in _digest(candidate.link)
    }
    if not digests:
        raise ValueError(f"{name}=={version}: no index gives the sha256 of a file of it.")
    return tuple(sorted(digests))


def _digest(link: Any) -> Iterator[str]:
    if link.hash_name == "sha256":
        yield link.hash
    elif link.scheme == "file":
        yield hashlib.sha256(Path(link.file_path).read_bytes()).hexdigest()


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
