"""Shards of servers on this machine: fetched whole, checked on arrival, bounded, shared.

Any number of processes may use the same folder. A shard appears by rename, when all of it has come
and its hash is right. A reader holds a shared lock on its shard, which is then never removed. One
process fetches a shard while the others wait for it. Locks die with the process that holds them.
"""

import contextlib
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from storage.atomic import TEMPORARY_SUFFIX, atomic_writer
from storage.cache import cache_folder
from storage.digests import canonical_json, sha256_hex, sha256_of_file
from storage.errors import TrilightError
from storage.file_locks import hold_lock, take_lock
from storage.remote.transfers import TransferFailed, download, facts_of, unreadable, version_of
from storage.remote.url import RemoteUrl

LIMIT_VARIABLE = "TRILIGHT_SHARD_CACHE_GB"
"""Environment variable with the size of the cache."""
DEFAULT_LIMIT_GB = 64.0
_ARRIVALS = 2
"""How often a shard is fetched whose bytes are wrong: the second time tells a bad line from a bad
file."""
_LOCKS = 64
"""Two shards may share a lock by chance; one is then fetched after the other."""
_STALE_S = 24 * 3600.0


@dataclass(frozen=True)
class ShardCache:
    """A folder of shards by URL and hash."""

    root: Path
    """The folder; it belongs to the cache alone."""
    max_bytes: int
    """Limit of all shards together. What is being read stays even beyond it."""

    def open(self, url: RemoteUrl, *, num_bytes: int | None, sha256: str | None) -> BinaryIO:
        """Return a shard, open for reading and safe from removal until it is closed.

        Args:
            url: the shard.
            num_bytes: its size, where a manifest says it.
            sha256: its digest, where a manifest says it; without one, the shard is known by what
                the server says of it, and its bytes are not checked.

        Raises:
            TrilightError: it cannot be fetched, has another size, twice has the wrong bytes, or
                the disk is full.
        """
        try:
            path = self.root / _name(url, sha256)
            while True:
                if (stream := _open_shared(path)) is not None:
                    return stream
                with hold_lock(self._lock_of(path), wait=True):
                    if not path.exists():
                        self._fetch(url, path, num_bytes, sha256)
        except TransferFailed as error:
            raise unreadable(url, error) from error

    def keep(self, path: Path, url: RemoteUrl, sha256: str) -> None:
        """Move a shard of this machine into the cache, since it is on the server too.

        The file is gone afterwards, also where the cache has no room for it.

        Args:
            path: the shard.
            url: where it is on the server.
            sha256: its digest.
        """
        with contextlib.suppress(OSError):
            num_bytes = path.stat().st_size
            if num_bytes <= self.max_bytes:
                self._make_room(num_bytes)
                self.root.mkdir(parents=True, exist_ok=True)
                os.utime(path)
                os.replace(path, self.root / _name(url, sha256))
        path.unlink(missing_ok=True)

    def _fetch(self, url: RemoteUrl, path: Path, num_bytes: int | None, sha256: str | None) -> None:
        for _ in range(_ARRIVALS):
            self._make_room(num_bytes or 0)
            with contextlib.suppress(_WrongBytes), atomic_writer(path) as stream:
                download(url, stream, num_bytes=num_bytes, max_bytes=self.max_bytes)
                stream.flush()
                if sha256 is not None and sha256_of_file(Path(stream.name)) != sha256:
                    raise _WrongBytes
                return
        raise TrilightError(
            f"{url.what} {url.display_url!r}: the bytes are not those of the manifest (sha256 "
            f"differs, {_ARRIVALS} times); expected {sha256}. Fix the file on the server."
        )

    def _make_room(self, num_bytes: int) -> None:
        """Remove the least recently read shards, until `num_bytes` more fit within the limit."""
        shards = []
        for path in self.root.glob("*"):
            with contextlib.suppress(OSError):
                stat = path.stat()
                if path.suffix != TEMPORARY_SUFFIX:
                    shards.append((stat.st_mtime_ns, path, stat.st_size))
                elif time.time() - stat.st_mtime > _STALE_S:  # a killed process left it
                    path.unlink()
        taken = num_bytes + sum(size for _, _, size in shards)
        for _, path, size in sorted(shards):
            if taken <= self.max_bytes:
                return
            if _remove_unread(path):
                taken -= size

    def _lock_of(self, path: Path) -> Path:
        number = int(sha256_hex(path.name.encode())[:8], 16) % _LOCKS
        return self.root.with_name(f"{self.root.name}-locks") / f"{number:02d}"


class _WrongBytes(Exception):
    """A shard arrived with another hash."""


def shard_cache() -> ShardCache:
    """Return the user's cache; raises TrilightError for a size that is no number above 0."""
    text = os.environ.get(LIMIT_VARIABLE, str(DEFAULT_LIMIT_GB))
    try:
        limit_gb = float(text)
    except ValueError:
        limit_gb = 0.0
    if not 0 < limit_gb < float("inf"):
        raise TrilightError(
            f"{LIMIT_VARIABLE} is {text!r}; expected a number of gigabytes above 0."
        )
    return ShardCache(cache_folder("shards"), int(limit_gb * 1e9))


def _name(url: RemoteUrl, sha256: str | None) -> str:
    """Return the name of a shard in the cache: nothing but hexadecimal digits and a dash."""
    if sha256 is not None:
        return f"{sha256_hex(url.display_url.encode())[:16]}-{sha256}"
    facts = facts_of(url)
    # without a digest, a query may be what tells two files apart
    place = canonical_json([url.display_url, url.query])
    version = canonical_json([facts.get("size"), version_of(facts)])
    return f"{sha256_hex(place)[:16]}-{sha256_hex(version)}"


def _open_shared(path: Path) -> BinaryIO | None:
    """Open a shard that is there, lock it against removal, and note that it was used."""
    try:
        stream = path.open("rb")
    except (FileNotFoundError, NotADirectoryError):
        return None
    # what is removed before this stays readable all the same
    take_lock(stream.fileno(), shared=True, wait=True)
    with contextlib.suppress(OSError):
        os.utime(path)
    return stream


def _remove_unread(path: Path) -> bool:
    """Remove a shard unless a process reads it; return whether its bytes are free."""
    try:
        with path.open("r+b") as stream:  # NFS gives a lock of one's own to writers alone
            if not take_lock(stream.fileno()):
                return False
            path.unlink(missing_ok=True)
        return True
    except OSError:
        return False
