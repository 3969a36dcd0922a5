"""Local copies of a remote folder's files: downloaded once, whole or not at all.

A file lies below `files` under its own name, since the files of a glTF name each other. The
server's version of it is stored below `versions`: while the server reports the same version, the
file is not downloaded again. The files that a glTF names are downloaded with it.
"""

import errno
import json
import os
import posixpath
import threading
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from fsspec.asyn import sync
from fsspec.callbacks import Callback

from pipeline.objects.remote.folder import RemoteFolder
from storage.atomic import atomic_writer, remove_leftovers, write_atomically
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.remote.fetch import version_of
from storage.remote.safe_url import printable
from storage.remote.tries import Interrupted, Pace, TransferFailed, with_tries
from storage.remote.url import transfer_timeout
from storage.typed_json import read_json

_MAX_NAME_BYTES = 220
"""File systems allow 255; the rest is for the name of an unfinished file."""
_MAX_PATH_BYTES = 2000
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
_NAME_ERRORS = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.EILSEQ)
_MAX_BUFFERS = 100
_MAX_JSON_BYTES = 64_000_000
_STALE_S = 24 * 3600.0


class RemoteFiles:
    """The local copies of a remote folder's files; safe for several threads."""

    def __init__(self, folder: RemoteFolder, root: Path, max_bytes: int) -> None:
        """Open the local copies and remove leftovers of earlier runs.

        Args:
            folder: the remote folder.
            root: local folder for this remote folder alone.
            max_bytes: largest accepted object in bytes, with the buffers that it names.
        """
        self.files = Path(os.path.realpath(root)) / "files"
        self.stop = threading.Event()
        self._versions = self.files.parent / "versions"
        self._folder = folder
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._outcomes: dict[str, _Outcome] = {}
        # younger files may belong to a running process
        remove_leftovers(self.files, older_than_s=_STALE_S)

    def path(self, name: str) -> Path:
        """Return the local path of a file; raises TransferFailed for unsafe names."""
        parts = name.split("/")
        encoded = [os.fsencode(part) for part in parts]
        if (
            any(part in ("", ".", "..") or "\x00" in part for part in parts)
            or max(map(len, encoded)) > _MAX_NAME_BYTES
            or sum(map(len, encoded)) > _MAX_PATH_BYTES
        ):
            message = f"the name {printable(name)[:100]!r} cannot be that of a file here"
            raise TransferFailed("unsafe_name", message)
        return self.files / name

    def fetch_object(self, name: str) -> Path:
        """Download a file, and the buffers of a `.gltf`; return its local path.

        Raises:
            TransferFailed: unsafe_name, too_large_bytes, too_many_buffers, download_failed.
            TrilightError: the disk is full or cannot be written.
        """
        path = self.fetch(name)
        if name.lower().endswith(".gltf"):
            buffers = buffer_names(path, name)
            if len(buffers) > _MAX_BUFFERS:
                message = f"names {len(buffers)} buffers; expected at most {_MAX_BUFFERS}"
                raise TransferFailed("too_many_buffers", message)
            total = path.stat().st_size
            for buffer in buffers:
                try:
                    total += self.fetch(buffer).stat().st_size
                except TransferFailed as error:
                    message = f"buffer {printable(buffer)[:100]}: {error.message}"
                    raise TransferFailed(error.reason, message) from error
                self._check_size(total)
        return path

    def fetch(self, name: str) -> Path:
        """Download one file once per instance; raises as `fetch_object`."""
        with self._lock:
            outcome = self._outcomes.setdefault(name, _Outcome())
        with outcome.lock:
            if outcome.path is None and outcome.error is None:
                try:
                    outcome.path = self.path(name)
                    limit = _Limit(self._check_size, self.stop)
                    with_tries(lambda: self._refresh(name, self.path(name), limit))
                except TransferFailed as error:
                    outcome.error = error
        if outcome.error is not None:
            raise outcome.error
        assert outcome.path is not None
        return outcome.path

    def _refresh(self, name: str, path: Path, limit: "_Limit") -> None:
        """Download a file unless the local copy has the server's version."""
        facts = self._folder.facts(name)
        if facts.get("type") == "directory":
            raise TransferFailed("download_failed", "is a folder, not a file")
        size = facts.get("size")
        self._check_size(size or 0)
        version = version_of(facts)
        if size is not None:
            version["size"] = str(size)
        note = self._versions / f"{sha256_hex(os.fsencode(name))}.json"
        if version and _is_here(path, note, version):
            return
        self._transfer(name, path, size, limit)
        write_atomically(note, json.dumps(version, sort_keys=True).encode())

    def _transfer(self, name: str, path: Path, size: int | None, limit: "_Limit") -> None:
        try:
            with atomic_writer(path) as stream:
                self._fill(name, Path(stream.name), size, limit)
        except TrilightError as error:
            if isinstance(error.__cause__, OSError) and error.__cause__.errno in _NAME_ERRORS:
                message = f"the name {printable(name)[:100]!r} clashes with another one here"
                raise TransferFailed("unsafe_name", message) from error
            raise

    def _fill(self, name: str, temporary: Path, size: int | None, limit: "_Limit") -> None:
        """Write the bytes of a file to a temporary path, which the caller holds open."""
        limit.value = 0  # every try starts again
        driver = self._folder.driver
        address = self._folder.address(name)
        get = driver.get_file
        if self._folder.url.is_http:  # `get_file` would apply its own limits
            get = partial(sync, driver.loop, partial(driver._get_file, timeout=transfer_timeout()))
        try:
            get(address, str(temporary), callback=limit)
        except OSError as error:
            if error.errno in _DISK_ERRORS:
                raise
            # Network errors are OSErrors too, and must not count as disk errors.
            raise Interrupted from error
        received = temporary.stat().st_size
        self._check_size(received)
        if size is not None and received != size:
            raise Interrupted from EOFError(f"got {received} of {size} bytes")

    def _check_size(self, size: int) -> None:
        if size > self._max_bytes:
            message = f"{size} bytes; expected <= {self._max_bytes}"
            raise TransferFailed("too_large_bytes", message)


class _Outcome:
    """The outcome of one file's download; its lock is held during the transfer."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.path: Path | None = None
        self.error: TransferFailed | None = None


class _Limit(Callback):
    """Aborts a transfer that grows too large, is too slow, or belongs to an ended run."""

    def __init__(self, check: Any, stop: threading.Event) -> None:
        super().__init__()
        self._check = check
        self._stop = stop
        self._pace = Pace(lambda: self.value)

    def set_size(self, size: int | None) -> None:
        super().set_size(size)
        self._check(size or 0)

    def relative_update(self, inc: int = 1) -> None:
        super().relative_update(inc)
        self._check(self.value)
        if self.value != self.size:  # a complete file is not too slow
            self._pace.require()
        if self._stop.is_set():
            raise TransferFailed("download_failed", "the run was ended")


def _is_here(path: Path, note: Path, version: dict[str, str]) -> bool:
    try:
        known = read_json(note.read_bytes(), dict[str, str], str(note))
        return known == version and str(path.stat().st_size) == known.get(
            "size", str(path.stat().st_size)
        )
    except (OSError, ValueError):
        return False


def buffer_names(path: Path, name: str) -> list[str]:
    """Return the files that the buffers of a `.gltf` name, each once, in order.

    Other URIs than relative ones below the file's folder are left out, and a file that is not a
    glTF has none: the mesh stage reads it again and reports the error.

    Args:
        path: the file on this machine.
        name: its path below the remote folder; the results are such paths too.
    """
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            return []
        tree = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return []
    buffers = tree.get("buffers") if isinstance(tree, dict) else None
    folder = posixpath.dirname(name)
    names: dict[str, None] = {}
    for buffer in buffers if isinstance(buffers, list) else ():
        uri = buffer.get("uri") if isinstance(buffer, dict) else None
        inner = _inner(uri) if isinstance(uri, str) else None
        if inner is not None:
            names[posixpath.join(folder, inner)] = None
    return list(names)


def _inner(uri: str) -> str | None:
    """Return the path that a relative URI names below its folder, or None."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        return None
    inner = posixpath.normpath(unquote(uri))
    if parts.scheme or parts.netloc or not uri or "\x00" in inner or "\n" in inner:
        return None
    if inner.startswith("/") or inner in (".", "..") or inner.startswith("../"):
        return None
    return inner
