"""Objects of a remote folder: listed, then downloaded to the cache that all datasets share.

A file lies below `files` under its own name, since the files of a glTF name each other. The
server's version of it is stored below `versions`: while the server reports the same version, the
file is not downloaded again. The files that a glTF names are downloaded with it, each once, whole
or not at all. Nothing is written on the server.
"""

import contextlib
import dataclasses
import errno
import html
import json
import os
import posixpath
import threading
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, cast
from urllib.parse import unquote

from pipeline.foreign.gltf.document import read_container
from pipeline.foreign.material_files import is_elsewhere
from pipeline.objects.listing import Listing, fetch_all
from pipeline.objects.local.folder import (
    CATALOGUE_NAMES,
    list_files,
    only_catalogue,
    read_catalogue,
)
from storage.atomic import atomic_writer, remove_leftovers, write_atomically
from storage.cache import cache_folder
from storage.digests import sha256_hex
from storage.errors import Rejected, TrilightError
from storage.records.objects import ObjectRecord
from storage.remote.transfers import (
    TransferFailed,
    download,
    is_absent,
    unreadable,
    version_of,
    with_tries,
)
from storage.remote.url import RemoteUrl, printable, safe_url, shared_driver

_MAX_NAME_BYTES = 220
"""File systems allow 255; the rest is for the name of an unfinished file."""
_MAX_PATH_BYTES = 2000
_NAME_ERRORS = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.EILSEQ)
_MAX_BUFFERS = 100
_STALE_S = 24 * 3600.0
_MAX_FOLDERS = 10_000
_MAX_DEPTH = 32
"""Maximum depth of folders: a server may answer every address with the same page."""
MAX_BYTES = 200_000_000
"""Largest downloaded object with its buffers, in bytes: the limit of the mesh stage."""


class RemoteFolder:
    """Files of a remote folder, and their local copies; safe for several threads.

    Files have names: the unquoted path below the folder, with / between parts.
    """

    def __init__(self, url: RemoteUrl) -> None:
        """Open the driver, and remove leftovers of earlier runs.

        Raises:
            TrilightError: the driver's package is missing.
        """
        self.url = url
        self.driver = shared_driver(url)
        self.driver.invalidate_cache()  # one driver keeps listings although that is turned off
        root = cache_folder("objects") / sha256_hex(url.display_url.encode())[:32]
        self.files = Path(os.path.realpath(root)) / "files"
        self.stop = threading.Event()
        self._addresses: dict[str, str] = {}
        self._facts: dict[str, dict[str, Any]] = {}
        self._lock = threading.Lock()
        self._outcomes: dict[str, Future[Path]] = {}
        # younger files may belong to a running process
        remove_leftovers(self.files, older_than_s=_STALE_S)

    def url_of(self, name: str) -> RemoteUrl:
        """Return the URL of a file, as the listing has it where there is one."""
        address = self._addresses.get(name)
        return dataclasses.replace(self.url, root=address) if address else self.url.child(name)

    def display_url(self, name: str) -> str:
        """Return the URL of a file for messages and documents, without secrets."""
        return safe_url(self.url_of(name).display_url)

    def name_of(self, record: ObjectRecord) -> str:
        """Return the name of the file of a record."""
        return Path(record.path).relative_to(self.files).as_posix()

    def has(self, name: str) -> bool:
        """Return True where a file exists; False also where the server denies access.

        Raises:
            TrilightError: the server gives no answer.
        """
        try:  # a folder of this name is no catalogue
            return bool(self._ask(name)["type"] == "file")
        except TransferFailed as error:
            if is_absent(error):
                return False
            raise unreadable(self.url, error) from error

    def _ask(self, name: str) -> dict[str, Any]:
        """Return what the driver says of a file; one driver lists a whole folder once for all."""
        return with_tries(lambda: dict(self.driver.info(self.url_of(name).root)))

    def names(self) -> list[str]:
        """Return the names of all files, at any depth.

        Raises:
            TrilightError: the folder cannot be listed, or has no end.
        """
        try:
            return self._names_by_links() if self.url.is_http else self._names_by_find()
        except TransferFailed as error:
            hint = " Public buckets need FSSPEC_S3_ANON=true." if self.url.scheme == "s3" else ""
            raise TrilightError(
                f"objects {self.url.display_url!r}: cannot be listed ({error.message}); expected a "
                "folder with a page that lists its files, or with objects.jsonl or objects.csv. "
                f"Check the URL and your access to it.{hint}"
            ) from error

    def _names_by_find(self) -> list[str]:
        start = f"{self.url.root}/"
        listing = with_tries(lambda: self.driver.find(self.url.root, detail=True))
        self._facts = {
            address.removeprefix(start): facts
            for address, facts in listing.items()
            if address.startswith(start) and address != start
        }
        return sorted(self._facts)

    def _names_by_links(self) -> list[str]:
        """Follow the links of the server's listings, only those below the folder."""
        names: dict[str, str] = {}
        folders = {f"{self.url.root}/"}
        waiting = list(folders)
        deepest = self.url.root.count("/") + _MAX_DEPTH
        while waiting:
            folder = waiting.pop()
            for link in with_tries(partial(self.driver.ls, folder, detail=False)):
                address = html.unescape(link).replace("/./", "/")
                inner = _below(address, self.url.root)
                if inner is None or address in folders:
                    continue
                if address.endswith("/"):
                    folders.add(address)
                    waiting.append(address)
                else:
                    names[inner] = address
            if len(folders) > _MAX_FOLDERS or folder.count("/") > deepest:
                raise TrilightError(
                    f"objects {self.url.display_url!r}: the listing has no end; expected at most "
                    f"{_MAX_FOLDERS} folders, {_MAX_DEPTH} deep. Give it objects.jsonl."
                )
        self._addresses = names
        return sorted(names)

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
        facts = self._facts.get(name) or self._ask(name)
        if facts.get("type") == "directory":
            raise TransferFailed("download_failed", "is a folder, not a file")
        size = facts.get("size")
        self._check_size(size or 0)
        version = version_of(facts)
        if size is not None:
            version["size"] = str(size)
        record = json.dumps(version, sort_keys=True).encode()
        versions = self.files.parent / "versions"
        note = versions / f"{sha256_hex(os.fsencode(name))}.json"
        if not version or not _is_here(path, note, record, size):
            try:
                with atomic_writer(path) as stream:
                    target = cast(BinaryIO, _StoppableStream(stream, self.stop))
                    download(self.url_of(name), target, num_bytes=size, max_bytes=MAX_BYTES)
            except TrilightError as error:
                if isinstance(error.__cause__, OSError) and error.__cause__.errno in _NAME_ERRORS:
                    message = f"the name {printable(name)[:100]!r} clashes with another one here"
                    raise TransferFailed("unsafe_name", message) from error
                raise
            write_atomically(note, record)
        return path

    def _check_size(self, size: int) -> None:
        if size > MAX_BYTES:
            message = f"{size} bytes; expected <= {MAX_BYTES}"
            raise TransferFailed("too_large_bytes", message)


def _below(address: str, root: str) -> str | None:
    """Return the file name of a link, or None where it leads elsewhere or sorts the page."""
    if not address.startswith(f"{root}/") or "?" in address or "#" in address:
        return None
    inner = unquote(address[len(root) + 1 :], errors="surrogateescape")
    hidden_or_upward = any(part.startswith(".") for part in inner.split("/"))
    return None if hidden_or_upward or not inner else inner


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


def _is_here(path: Path, note: Path, version: bytes, size: int | None) -> bool:
    with contextlib.suppress(OSError):
        return note.read_bytes() == version and size in (None, path.stat().st_size)
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
        tree, _ = read_container(path.read_bytes(), ".gltf")
    except (OSError, Rejected):
        return []
    buffers = tree.get("buffers")
    rows = [row for row in (buffers if isinstance(buffers, list) else ()) if isinstance(row, dict)]
    inner = [_inner(row["uri"]) for row in rows if isinstance(row.get("uri"), str)]
    folder = posixpath.dirname(name)
    return list(dict.fromkeys(posixpath.join(folder, each) for each in inner if each is not None))


def _inner(uri: str) -> str | None:
    """Return the path that a relative URI names below its folder, or None."""
    inner = posixpath.normpath(unquote(uri))
    is_name = inner.split("/")[0] not in ("", ".", "..") and not {"\x00", "\n"} & set(inner)
    return inner if is_name and not is_elsewhere(uri) else None


def list_remote(url: RemoteUrl, licence: str | None) -> Listing:
    """List the objects of a remote folder: its catalogue's rows, or else its object files.

    Only the catalogue is downloaded here. Later downloads go to the cache; a cached object is
    downloaded again only where the server reports a change.

    `licence` is the user's for files without a statement.

    Raises:
        TrilightError: a driver is missing, the folder cannot be read or listed or holds no object,
            its catalogue is wrong, or there are a catalogue and a `licence`.
    """
    folder = RemoteFolder(url)
    if catalogue := only_catalogue(folder.has, licence):
        listing = _list_catalogue(folder, catalogue)
    else:
        listing = _list_object_files(folder, licence)

    def fetch(record: ObjectRecord) -> Path:
        name = folder.name_of(record)
        try:
            return folder.fetch_object(name)
        except TransferFailed as error:
            message = f"{folder.display_url(name)}: {error.message}"
            raise TransferFailed(error.reason, message) from error

    fetch_some = partial(fetch_all, fetch=fetch, cancel=folder.stop.set)
    return dataclasses.replace(listing, fetch=fetch_some)


def _list_catalogue(folder: RemoteFolder, catalogue: str) -> Listing:
    try:
        records = read_catalogue(folder.fetch(catalogue))
    except TransferFailed as error:
        raise unreadable(folder.url_of(catalogue), error) from error
    urls = [record.source_url or folder.display_url(folder.name_of(record)) for record in records]
    rows = zip(records, urls, strict=True)
    return Listing(records=[dataclasses.replace(record, source_url=url) for record, url in rows])


def _list_object_files(folder: RemoteFolder, licence: str | None) -> Listing:
    names = folder.names()
    for catalogue in set(CATALOGUE_NAMES) & set(names):
        # without the catalogue, the run could use objects that it forbids
        raise TrilightError(
            f"objects {folder.url.display_url!r}: {catalogue} is listed but cannot be fetched; "
            "expected a readable catalogue. Check your access to it."
        )
    return list_files(
        names,
        licence,
        lambda name: {"path": str(folder.path(name)), "source_url": folder.display_url(name)},
    )
