"""The files of a dataset: in a folder of this machine, or below a URL."""

import os
from abc import ABC, abstractmethod
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from storage.dataset.manifest import ShardEntry
from storage.digests import sha256_of_stream
from storage.errors import TrilightError
from storage.records.safe_read import open_plain
from storage.remote.cache import shard_cache
from storage.remote.fetch import download, facts_of, unreadable
from storage.remote.tries import TransferFailed, is_missing
from storage.remote.url import RemoteUrl, parse_url

MAX_BESIDE_BYTES = 1 << 30
"""Largest file beside the shards: a manifest takes about 200 bytes a member."""


class _Files(ABC):
    """What is beside the shards."""

    @abstractmethod
    def open_beside(self, name: str) -> BinaryIO | None:
        """Open a file beside the shards, or return None where there is none."""

    def read(self, name: str) -> bytes | None:
        """Return a file beside the shards, or None where there is none."""
        stream = self.open_beside(name)
        if stream is None:
            return None
        with stream:
            return stream.read()


class LocalFiles(_Files):
    """A folder of this machine."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.shown = str(root)
        self._checked: dict[str, tuple[int, ...]] = {}

    def open_beside(self, name: str) -> BinaryIO | None:
        try:
            return open_plain(self.root / name)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise TrilightError(
                f"{self.root / name}: cannot be read ({error.strerror})."
            ) from error

    def num_bytes(self, shard: ShardEntry) -> int | None:
        """Return the size of a shard, or None where it is missing."""
        path = self.root / shard.name
        return path.stat().st_size if path.exists() else None

    def open(self, shard: ShardEntry, *, checked: bool) -> BinaryIO:
        """Open a shard for reading.

        Args:
            shard: which one.
            checked: look at its digest before, once as long as the file stays as it is.

        Raises:
            TrilightError: it is missing, or its bytes are not those of the manifest.
        """
        path = self.root / shard.name
        try:
            stream = open_plain(path)
        except FileNotFoundError as error:
            raise TrilightError(
                f"{path}: the shard is missing; run `trilight generate` again to make it."
            ) from error
        except OSError as error:
            raise TrilightError(
                f"{path}: cannot be read ({error.strerror}); mend its permissions."
            ) from error
        if checked:
            self._check(path, stream, shard)
        return stream

    def _check(self, path: Path, stream: BinaryIO, shard: ShardEntry) -> None:
        facts = os.fstat(stream.fileno())
        seen = (facts.st_ino, facts.st_size, facts.st_mtime_ns)
        if self._checked.get(shard.name) == seen:
            return
        if sha256_of_stream(stream) != shard.sha256:
            stream.close()
            raise TrilightError(
                f"{path}: the bytes are not those of the manifest (sha256 differs). Delete the "
                "file and run `trilight generate` again to make it anew."
            )
        stream.seek(0)
        self._checked[shard.name] = seen


class RemoteDatasetFiles(_Files):
    """A folder on a server. Its shards come whole to the cache of this machine."""

    def __init__(self, url: RemoteUrl) -> None:
        self.url = url
        self.shown = url.shown

    def open_beside(self, name: str) -> BinaryIO | None:
        url = self.url.child(name)
        stream: BinaryIO = TemporaryFile()
        try:
            download(url, stream, num_bytes=None, max_bytes=MAX_BESIDE_BYTES)
            stream.seek(0)
            return stream
        except BaseException as error:
            stream.close()
            if not isinstance(error, TransferFailed):
                raise
            if error.__cause__ is not None and is_missing(error.__cause__):
                return None
            raise unreadable(url, error) from error

    def num_bytes(self, shard: ShardEntry) -> int | None:
        """Return the size of a shard, or None where it is missing or the size is not said."""
        url = self.url.child(shard.name)
        try:
            return facts_of(url).num_bytes
        except TransferFailed as error:
            if error.__cause__ is not None and is_missing(error.__cause__):
                return None
            raise unreadable(url, error) from error

    def open(self, shard: ShardEntry, *, checked: bool) -> BinaryIO:
        """Open a shard for reading; its digest is looked at when it arrives, in any case.

        Raises:
            TrilightError: as `storage.remote.cache`.
        """
        url = self.url.child(shard.name)
        return shard_cache().open(url, num_bytes=shard.num_bytes, sha256=shard.sha256)


DatasetFiles = LocalFiles | RemoteDatasetFiles


def dataset_files(url: str) -> DatasetFiles:
    """Return where the files of a dataset are; raises TrilightError for a URL that is refused."""
    place = parse_url(url, what="dataset")
    return LocalFiles(place) if isinstance(place, Path) else RemoteDatasetFiles(place)
