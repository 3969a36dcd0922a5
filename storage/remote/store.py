"""`Store`: where a dataset is: a folder, a bucket (s3://, gs://) or a server, by fsspec.

Files have names relative to it. A file appears whole or not at all, and once if asked. A bucket
shows one when all of it has come, however large it is, so a kill leaves nothing half written; parts
of an upload that was cut off are invisible, and a rule of the bucket may delete them
(AbortIncompleteMultipartUpload). "Only once" is a condition that its server itself checks.

Claims only avoid that work is done twice. In a folder a claim is a lock, which ends with its holder
(storage.file_locks). A bucket does not see that a machine dies: there a claim is a file, and one
that a worker has seen for `LEASE_S` counts as a dead machine's; the next one may then be made.
"""

import contextlib
import functools
import io
import itertools
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from storage.atomic import atomic_writer, write_atomically
from storage.digests import sha256_of_stream
from storage.errors import EnvironmentFailure, ShardMissing, TrilightError, Unreadable
from storage.file_locks import hold_lock
from storage.remote.shard_cache import shard_cache
from storage.remote.transfers import (
    TransferFailed,
    download,
    facts_of,
    is_missing,
    is_taken,
    may_pass,
    unreadable,
    with_tries,
)
from storage.remote.url import RemoteUrl, shared_driver

WRITABLE = ("s3", "gs")
"""Schemes of servers that can be told to write a file only where there is none."""
LEASE_S = 900.0
"""Longest time that a claim in a bucket keeps others off, s; longer work is done twice."""
MAX_FILE_BYTES = 1 << 30
"""Largest file that is read whole: a manifest takes 220 bytes a shard, a lock 400 an object."""
_PART_BYTES = 32 << 20
_PARTS_AT_ONCE = 4
"""Part size and concurrency together bound the memory of an upload."""
_PROBE = ".staging/once"
"""Test file that shows whether the server creates a file only once; it may stay."""
_FREE = b"free"
"""Content of a claim in a bucket whose holder is done."""


class LocalStore:
    """A folder of this machine, or of one that all machines see at the same place."""

    is_here = True
    """True for a folder: what is written there is published."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.display_name = str(root)
        """The folder or URL without secrets, for messages."""
        self._checked: dict[str, tuple[int, ...]] = {}

    def get(self, name: str, num_bytes: int | None = None) -> bytes | None:
        """Return a file, or its first bytes; None where there is none.

        Raises:
            TrilightError: it cannot be read (an EnvironmentFailure where that may pass).
        """
        # slow, and most names need no file
        from storage.records.safe_read import name_unreadable, open_plain

        path = self.root / name
        with name_unreadable(path), contextlib.suppress(FileNotFoundError, NotADirectoryError):
            with open_plain(path) as stream:
                return stream.read(-1 if num_bytes is None else num_bytes)
        return None

    def put(self, name: str, content: Path | bytes) -> None:
        """Write a file, or replace it; one that stands at its place in a folder stays.

        Raises:
            TrilightError: it cannot be written (an EnvironmentFailure where that may pass).
        """
        self._write(name, content, replace=True)

    def create_if_absent(self, name: str, content: Path | bytes) -> bool:
        """Write a file unless it exists, and return whether it was written; otherwise as `put`.

        A file that stands at its place in a folder counts as written. Where the answer to a
        successful write is lost, another worker counts as its writer.
        """
        return self._write(name, content, replace=False)

    def _write(self, name: str, content: Path | bytes, *, replace: bool) -> bool:
        path = self.root / name
        if content == path:
            return True
        with atomic_writer(path, replace=replace) as stream:
            if isinstance(content, bytes):
                stream.write(content)
            else:
                with content.open("rb") as source:
                    shutil.copyfileobj(source, stream)
            ours = os.fstat(stream.fileno())
        return os.path.samestat(ours, path.stat())

    def list(self, folder: str = "") -> set[str]:
        """Return the names of the files in one folder; as `get` raises."""
        place = folder.rstrip("/")
        with contextlib.suppress(FileNotFoundError), os.scandir(self.root / place) as entries:
            names = {entry.name for entry in entries if entry.is_file()}
            return {f"{place}/{name}" if place else name for name in names}
        return set()

    def hold_lock(self, name: str) -> contextlib.AbstractContextManager[bool]:
        """Hold the claim on a file for the block; yield whether it is ours; as `put` raises."""
        return hold_lock(claim_of(self.root / name))

    def num_bytes(self, name: str) -> int | None:
        """Return the size of a shard, or None where the server does not state it.

        Raises:
            ShardMissing: there is none.
            Unreadable: it cannot be looked at, or the server gives no answer.
        """
        path = self.root / name
        with _name_missing(path):
            return path.stat().st_size

    def open_shard(self, name: str, *, num_bytes: int, sha256: str, checked: bool) -> BinaryIO:
        """Open a shard for reading.

        Args:
            name: its name.
            num_bytes: its size.
            sha256: its digest.
            checked: check the digest first, once as long as the file stays unchanged; what comes
                from a server always is.

        Raises:
            TrilightError: it is missing, cannot be read, or its bytes are not those of the digest.
        """
        from storage.records.safe_read import open_plain

        path = self.root / name
        with _name_missing(path):
            stream = open_plain(path)
        facts = os.fstat(stream.fileno())
        seen = (facts.st_ino, facts.st_size, facts.st_mtime_ns)
        if checked and self._checked.get(name) != seen:
            if sha256_of_stream(stream) != sha256:
                stream.close()
                raise TrilightError(
                    f"{path}: the bytes are not those of the manifest (sha256 differs). Delete the "
                    "file and run `trilight generate` again to make it."
                )
            stream.seek(0)
            self._checked[name] = seen
        return stream


@contextlib.contextmanager
def _name_missing(path: Path) -> Iterator[None]:
    """Raise ShardMissing or Unreadable for what the system says of a shard within the block."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ShardMissing(
            f"{path}: the shard is missing; run `trilight generate` again to make it."
        ) from error
    except OSError as error:
        raise Unreadable(
            f"{path}: cannot be read ({error.strerror}); fix its permissions."
        ) from error


class RemoteStore:
    """A folder in a bucket, by fsspec; one on a plain server can only be read.

    Its shards come whole to the cache of this machine.
    """

    is_here = False

    def __init__(self, url: RemoteUrl, work: Path | None = None) -> None:
        """Name the folder.

        Args:
            url: the folder.
            work: a folder of this machine for its claims, and its name as their holder, which is
                written at its first claim: a machine that is killed has its claims again at once.
        """
        self.url = url
        self.display_name = url.display_url
        self._work = work
        self._first_seen: dict[str, float] = {}

    def get(self, name: str, num_bytes: int | None = None) -> bytes | None:
        url = self.url.child(name)
        if num_bytes is None:
            stream = io.BytesIO()
            try:
                download(url, stream, num_bytes=None, max_bytes=MAX_FILE_BYTES)
            except TransferFailed as error:
                if is_missing(error):
                    return None
                raise unreadable(url, error) from error
            return stream.getvalue()

        def read() -> bytes | None:
            with contextlib.suppress(FileNotFoundError):
                return shared_driver(self.url).cat_file(url.root, start=0, end=num_bytes)
            return None

        return self._retry(read, "read")

    def put(self, name: str, content: Path | bytes) -> None:
        self._retry(lambda: self._upload(name, content, mode="overwrite"), "written")

    def create_if_absent(self, name: str, content: Path | bytes) -> bool:
        def create_file() -> bool:
            try:
                self._upload(name, content, mode="create")
            except Exception as error:  # drivers raise what they like
                if not is_taken(error):
                    raise
                return False
            return True

        return self._retry(create_file, "written")

    def list(self, folder: str = "") -> set[str]:
        return self._list_paths(folder, lambda driver, place: driver.ls(place, detail=True))

    def list_all(self) -> set[str]:
        """Return the names of all files, however deep; a thousand names are a request.

        There are none where they cannot be listed: on a plain server, or without the permission.
        """
        if self.url.scheme not in WRITABLE:
            return set()
        with contextlib.suppress(TrilightError):
            return self._list_paths("", lambda drv, place: drv.find(place, detail=True).values())
        return set()

    def _list_paths(self, folder: str, find: Callable[[Any, str], Iterable[Any]]) -> set[str]:
        root = f"{self.url.root}/"

        def find_files() -> list[str]:
            driver = shared_driver(self.url)
            driver.invalidate_cache()
            with contextlib.suppress(FileNotFoundError):
                rows = find(driver, f"{root}{folder}".rstrip("/"))
                return [row["name"] for row in rows if row["type"] == "file"]
            return []

        paths = self._retry(find_files, "listed")
        return {path.removeprefix(root) for path in paths if path.startswith(root)}

    @contextlib.contextmanager
    def hold_lock(self, name: str) -> Iterator[bool]:
        assert self._work is not None
        with hold_lock(claim_of(self._work / name)) as ours_here:  # one process of this machine
            claim = self._create_claim(name) if ours_here else None
            try:
                yield claim is not None
            finally:
                if claim is not None:
                    with contextlib.suppress(TrilightError):  # the lease ends it
                        self.put(claim, _FREE)

    def _create_claim(self, name: str) -> str | None:
        """Return the file of our claim, or None where another machine holds one."""
        for number in itertools.count():
            claim = f"{name}.claim-{number}"
            if self.create_if_absent(claim, self._worker):
                return claim
            holder = self.get(claim, len(self._worker))
            if holder == self._worker:
                return claim
            seen_s = time.monotonic() - self._first_seen.setdefault(claim, time.monotonic())
            if holder != _FREE and seen_s < LEASE_S:
                break
        return None

    @functools.cached_property
    def _worker(self) -> bytes:
        assert self._work is not None
        path = self._work / ".staging" / "worker"
        with hold_lock(claim_of(path), wait=True):  # other processes are the same worker
            if not path.exists():
                write_atomically(path, uuid.uuid4().hex.encode())
        return path.read_bytes()

    def require_create(self) -> None:
        """Raise TrilightError if the server writes a file again that it was to create once."""
        if self.create_if_absent(_PROBE, b"\n") and self.create_if_absent(_PROBE, b"\n"):
            raise TrilightError(
                f"{self.url.what} {self.url.display_url!r}: the server does not know conditional "
                "writes (If-None-Match, or ifGenerationMatch), so two workers could replace each "
                "other's files; expected one that refuses to create a file twice. Use another "
                "server, or a folder."
            )

    def num_bytes(self, name: str) -> int | None:
        url = self.url.child(name)
        try:
            return facts_of(url).get("size")
        except TransferFailed as error:
            if is_missing(error):
                raise ShardMissing(f"{url.display_url}: the shard is missing.") from error
            raise unreadable(url, error) from error

    def open_shard(self, name: str, *, num_bytes: int, sha256: str, checked: bool) -> BinaryIO:
        return shard_cache().open(self.url.child(name), num_bytes=num_bytes, sha256=sha256)

    def _upload(self, name: str, content: Path | bytes, *, mode: str) -> None:
        driver = shared_driver(self.url)
        target = self.url.child(name).root
        if isinstance(content, bytes):
            driver.pipe_file(target, content, mode=mode)
            return
        driver.put_file(
            str(content),
            target,
            mode=mode,
            chunksize=_PART_BYTES,
            max_concurrency=_PARTS_AT_ONCE,
        )

    def _retry(self, function: Callable[[], Any], what: str) -> Any:
        try:
            return with_tries(function)
        except TransferFailed as error:
            cause = error.__cause__
            lasting = cause is None or is_missing(cause) or not may_pass(cause)
            kind = TrilightError if lasting else EnvironmentFailure
            raise kind(
                f"{self.url.what} {self.url.display_url!r}: cannot be {what} ({error.message}); "
                "expected a bucket that exists, and access that lets you list, read and write "
                "there. What was finished is safe: fix it and run the same command again."
            ) from error


Store = LocalStore | RemoteStore
"""A place for files that several workers read and write at once."""


def claim_of(path: Path) -> Path:
    """Return the lock by which processes of a folder claim a file in it."""
    return path.with_suffix(".claim")
