"""Local copies of a remote folder's files: downloaded once, whole or not at all.

A file lies below `files` under its own name, since the files of a glTF name each other. The
server's version of it is stored below `versions`: while the server reports the same version, the
file is not downloaded again. The files that a glTF names are downloaded with it.
"""

import dataclasses
import errno
import json
import os
import posixpath
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import Any, BinaryIO, cast
from urllib.parse import unquote, urlsplit

from pipeline.objects.remote.folder import RemoteFolder
from storage.atomic import atomic_writer, remove_leftovers, write_atomically
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.remote.fetch import download, version_of
from storage.remote.retries import TransferFailed, with_tries
from storage.remote.safe_url import printable
from storage.typed_json import read_json

_MAX_NAME_BYTES = 220
"""File systems allow 255; the rest is for the name of an unfinished file."""
_MAX_PATH_BYTES = 2000
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
        self._outcomes: dict[str, Future[Path]] = {}
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
            is_first = name not in self._outcomes
            outcome = self._outcomes.setdefault(name, Future())
        if is_first:
            try:
                outcome.set_result(self._refresh(name))
            except BaseException as error:
                outcome.set_exception(error)
        return outcome.result()

    def _refresh(self, name: str) -> Path:
        """Download a file unless the local copy has the server's version; return its path."""
        path = self.path(name)
        facts = with_tries(lambda: self._folder.facts(name))
        if facts.get("type") == "directory":
            raise TransferFailed("download_failed", "is a folder, not a file")
        size = facts.get("size")
        self._check_size(size or 0)
        version = version_of(facts)
        if size is not None:
            version["size"] = str(size)
        note = self._versions / f"{sha256_hex(os.fsencode(name))}.json"
        if not version or not _is_here(path, note, version):
            self._transfer(name, path, size)
            write_atomically(note, json.dumps(version, sort_keys=True).encode())
        return path

    def _transfer(self, name: str, path: Path, size: int | None) -> None:
        url = dataclasses.replace(self._folder.url, root=self._folder.address(name))
        try:
            with atomic_writer(path) as stream:
                target = cast(BinaryIO, _StoppableStream(stream, self.stop))
                download(url, target, num_bytes=size, max_bytes=self._max_bytes)
        except TrilightError as error:
            if isinstance(error.__cause__, OSError) and error.__cause__.errno in _NAME_ERRORS:
                message = f"the name {printable(name)[:100]!r} clashes with another one here"
                raise TransferFailed("unsafe_name", message) from error
            raise

    def _check_size(self, size: int) -> None:
        if size > self._max_bytes:
            message = f"{size} bytes; expected <= {self._max_bytes}"
            raise TransferFailed("too_large_bytes", message)


class _StoppableStream:
    """An open file that takes no more bytes once the run has ended."""

    def __init__(self, stream: Any, stop: threading.Event) -> None:
        self._stream = stream
        self._stop = stop

    def write(self, data: bytes) -> None:
        if self._stop.is_set():
            raise TransferFailed("download_failed", "the run was ended")
        self._stream.write(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


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
