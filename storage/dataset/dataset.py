"""A dataset that is read, in a folder of this machine or on a server: manifest, files, samples."""

import contextlib
import os
import shlex
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO, TypeVar

from storage.conventions import SPLITS
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, decode_manifest, missing_manifest
from storage.dataset.shard import ShardReader
from storage.digests import sha256_of_stream
from storage.errors import EnvironmentFailure, ShardMissing, TrilightError, Unreadable
from storage.records.objects import Failure, LockedObject, decode_failures, decode_objects_lock
from storage.records.packed_maps import HeldMaps
from storage.records.safe_read import open_if_there, open_plain
from storage.records.sample import (
    Sample,
    SceneRecord,
    decode_sample,
    decode_scene,
    require_lawful,
)
from storage.remote.fetch import facts_of, fetch_if_there, unreadable
from storage.remote.retries import TransferFailed, is_missing
from storage.remote.shard_cache import shard_cache
from storage.remote.store import MAX_FILE_BYTES, WRITABLE
from storage.remote.url import RemoteUrl, parse_url

Record = TypeVar("Record", bound=SceneRecord)


def _open_error(path: Path, error: OSError) -> TrilightError:
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return ShardMissing(
            f"{path}: the shard is missing; run `trilight generate` again to make it."
        )
    return Unreadable(f"{path}: cannot be read ({error.strerror}); fix its permissions.")


class _Files(ABC):
    """The files next to the shards."""

    @abstractmethod
    def open_beside(self, name: str) -> BinaryIO | None:
        """Open a file next to the shards, or return None where there is none."""

    def read(self, name: str) -> bytes | None:
        """Return a file next to the shards, or None where there is none."""
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
        return open_if_there(self.root / name)

    def num_bytes(self, shard: ShardEntry) -> int | None:
        """Return the size of a shard; raises ShardMissing, or Unreadable."""
        path = self.root / shard.name
        try:
            return path.stat().st_size
        except OSError as error:
            raise _open_error(path, error) from error

    def open(self, shard: ShardEntry, *, checked: bool) -> BinaryIO:
        """Open a shard for reading.

        Args:
            shard: which one.
            checked: check its digest first, once as long as the file stays unchanged.

        Raises:
            TrilightError: it is missing, or its bytes are not those of the manifest.
        """
        path = self.root / shard.name
        try:
            stream = open_plain(path)
        except OSError as error:
            raise _open_error(path, error) from error
        if checked:
            self._check_shard_digest(path, stream, shard)
        return stream

    def _check_shard_digest(self, path: Path, stream: BinaryIO, shard: ShardEntry) -> None:
        facts = os.fstat(stream.fileno())
        seen = (facts.st_ino, facts.st_size, facts.st_mtime_ns)
        if self._checked.get(shard.name) == seen:
            return
        if sha256_of_stream(stream) != shard.sha256:
            stream.close()
            raise TrilightError(
                f"{path}: the bytes are not those of the manifest (sha256 differs). Delete the "
                "file and run `trilight generate` again to make it."
            )
        stream.seek(0)
        self._checked[shard.name] = seen


class RemoteDatasetFiles(_Files):
    """A folder on a server. Its shards come whole to the cache of this machine."""

    def __init__(self, url: RemoteUrl) -> None:
        self.url = url
        self.shown = url.display_url

    def open_beside(self, name: str) -> BinaryIO | None:
        url = self.url.child(name)
        stream: BinaryIO = TemporaryFile()
        try:
            if fetch_if_there(url, stream, max_bytes=MAX_FILE_BYTES):
                stream.seek(0)
                return stream
        except BaseException:
            stream.close()
            raise
        stream.close()
        return None

    def num_bytes(self, shard: ShardEntry) -> int | None:
        """Return the size of a shard, or None where the server does not state it.

        Raises:
            ShardMissing: there is none.
            Unreadable: the server gives no answer.
        """
        url = self.url.child(shard.name)
        try:
            return facts_of(url).num_bytes
        except TransferFailed as error:
            if error.__cause__ is not None and is_missing(error.__cause__):
                raise ShardMissing(f"{url.display_url}: the shard is missing.") from error
            raise unreadable(url, error) from error

    def open(self, shard: ShardEntry, *, checked: bool) -> BinaryIO:
        """Open a shard for reading; its digest is always checked on arrival.

        Raises:
            TrilightError: as `storage.remote.shard_cache`.
        """
        url = self.url.child(shard.name)
        return shard_cache().open(url, num_bytes=shard.num_bytes, sha256=shard.sha256)


DatasetFiles = LocalFiles | RemoteDatasetFiles


def dataset_files(url: str) -> DatasetFiles:
    """Return where the files of a dataset are; raises TrilightError for a URL that is refused."""
    place = parse_url(url, what="dataset")
    return LocalFiles(place) if isinstance(place, Path) else RemoteDatasetFiles(place)


_OF_DAMAGED_BYTES = (ValueError, LookupError, TypeError, EOFError, RecursionError, zlib.error)


@contextlib.contextmanager
def reading(dataset: str, shard: str) -> Iterator[None]:
    """Turn any error of reading a shard into one sentence with the next step.

    Args:
        dataset: its place, for messages.
        shard: its name.

    Raises:
        TrilightError: the block raised one, or another error that damaged bytes cause; of what was
            not read it says nothing more.
    """
    try:
        yield
    except (EnvironmentFailure, ShardMissing, Unreadable):
        raise
    except _OF_DAMAGED_BYTES as error:
        why = (
            str(error)
            if isinstance(error, TrilightError)
            else f"not as expected ({type(error).__name__})"
        )
        raise TrilightError(
            f"{shard}: {why.rstrip('.')}. The shard is damaged; `trilight verify "
            f"{shlex.quote(dataset)}` says how to repair it."
        ) from error


class Dataset:
    """The shards of one dataset, checked by digest as they are read."""

    def __init__(
        self,
        files: DatasetFiles,
        manifest: Manifest,
        num_listed: int | None = None,
        noted: Sequence[Failure] = (),
    ) -> None:
        """Name what is read.

        Args:
            files: where it is.
            manifest: what it is, with every shard that may be read.
            num_listed: how many of the shards the manifest on the disk lists; all by default.
            noted: what was rejected on the way to the others.
        """
        self.files = files
        self.manifest = manifest
        self.num_listed = len(manifest.shards) if num_listed is None else num_listed
        self._noted = noted

    @property
    def display_name(self) -> str:
        """The place of the dataset for messages, without secrets."""
        return self.files.shown

    @property
    def folder(self) -> DatasetFolder:
        """The dataset's folder; raises TrilightError where it is on a server."""
        if isinstance(self.files, RemoteDatasetFiles):
            raise TrilightError(
                f"dataset {self.display_name!r} is on a server; expected a local folder."
            )
        return DatasetFolder(self.files.root)

    @property
    def digest(self) -> str:
        """The dataset digest (storage.dataset.manifest)."""
        return self.manifest.dataset_digest

    def shards_of(self, split: str) -> list[ShardEntry]:
        """Return the shards of one split, by name."""
        return [shard for shard in self.manifest.shards if shard.split == split]

    def scenes(self, split: str | None = None) -> Iterator[SceneRecord]:
        """Yield the scenes of a split, or of all, without their pictures; as `read_scenes`."""
        for shard in self._shards(split):
            yield from self.read_scenes(shard)

    def samples(self, split: str | None = None) -> Iterator[Sample]:
        """Yield the scenes of a split, or of all, with their pictures, as `read_shard` does.

        `sample.radiance_rgb` is [V, R, R, 3] float32 linear radiance of the cameras of
        `sample.scene`, and `sample.views` says of each how it was rendered, and its error.
        """
        for shard in self._shards(split):
            yield from self.read_shard(shard)

    def _shards(self, split: str | None) -> list[ShardEntry]:
        if split is None:
            return list(self.manifest.shards)
        if split not in SPLITS:
            raise TrilightError(f"split is {split!r}; expected one of {', '.join(SPLITS)}.")
        return self.shards_of(split)

    def read_shard(self, shard: ShardEntry) -> Iterator[Sample]:
        """Yield the samples of a shard in the order of the file, after checking its digest.

        It raises TrilightError where the file is missing or its bytes are not those of the
        manifest.
        """
        held = HeldMaps()
        with self.open_shard(shard, checked=True) as opened:
            for key, members in opened:
                yield decode_sample(key, members, held)

    def read_scenes(self, shard: ShardEntry) -> Iterator[SceneRecord]:
        """Yield the samples of a shard without their pictures, through its headers.

        Only what is needed is read, so that a large dataset can be browsed; the digest of the shard
        is therefore not checked (`read_shard` and `trilight verify` do that). It raises
        TrilightError where the shard is missing or damaged, or a scene in it is unreadable or
        breaks a law.
        """
        yield from self._read(shard, None, decode_scene, lambda name: not name.endswith("exr"))

    def read_samples(self, shard: ShardEntry, keys: Iterable[str]) -> Iterator[Sample]:
        """Yield some samples of a shard with their pictures; otherwise as `read_scenes`."""
        yield from self._read(shard, keys, decode_sample)

    def _read(
        self,
        shard: ShardEntry,
        keys: Iterable[str] | None,
        decode: Callable[[str, Mapping[str, bytes], HeldMaps], Record],
        accepts: Callable[[str], bool] = lambda suffix: True,
    ) -> Iterator[Record]:
        held = HeldMaps()
        with self.open_shard(shard) as opened:
            for key in opened.samples if keys is None else keys:
                with reading(self.display_name, shard.name):
                    record = decode(key, opened.members(key, accepts), held)
                    require_lawful(record)
                yield record

    def keys(self, shard: ShardEntry) -> list[str]:
        """Return the keys of a shard's samples in the order of the file; as `read_scenes`."""
        with self.open_shard(shard) as opened:
            keys = list(opened.samples)
        if len(keys) != shard.num_samples:
            raise TrilightError(
                f"{shard.name}: {len(keys)} samples; expected {shard.num_samples}, as the manifest "
                f"says. Run `trilight verify {shlex.quote(self.display_name)} --repair`."
            )
        return keys

    def suffixes(self, shard: ShardEntry) -> set[str]:
        """Return the suffixes of all members of a shard's samples; as `read_scenes`."""
        with self.open_shard(shard) as opened:
            return {suffix for members in opened.samples.values() for suffix in members}

    def open_shard(self, shard: ShardEntry, *, checked: bool = False) -> ShardReader:
        """Open a shard; with `checked`, after its digest; as `read_scenes`."""
        stream = self.files.open(shard, checked=checked)
        with reading(self.display_name, shard.name):
            return ShardReader(stream, shard.name)

    def lock_bytes(self) -> bytes | None:
        """Return the file of the objects that were used, or None where the dataset has none."""
        return self.files.read("objects.lock.jsonl")

    def objects_lock(self) -> list[LockedObject]:
        """Return the objects that were used; none where the dataset has no lock."""
        data = self.lock_bytes()
        return [] if data is None else decode_objects_lock(data, "objects.lock.jsonl")

    def failures(self) -> list[Failure]:
        """Return what was rejected; none where the dataset does not say."""
        return [*decode_failures(self.files.read("failures.jsonl") or b""), *self._noted]


def open_dataset(url: str) -> Dataset:
    """Open the dataset in a local folder, or below a URL of http, https, s3, gs or hf.

    Of one that is still made, the shards that are noted so far count too, where the folder or
    bucket can be listed. It raises TrilightError where there is no readable manifest, the URL is
    refused, or the driver for it is not installed.
    """
    dataset = open_listed(url)
    if not _may_be_growing(dataset.files):
        return dataset
    # slow, and not needed to stream a whole set
    from storage.dataset.shard_notes import with_unlisted

    return with_unlisted(dataset)


def _may_be_growing(files: DatasetFiles) -> bool:
    if isinstance(files, LocalFiles):
        return DatasetFolder(files.root).staged_entries.exists()
    return files.url.scheme in WRITABLE


def open_listed(url: str) -> Dataset:
    """Open what the manifest lists of a dataset: nothing while it is made; as `open_dataset`."""
    files = dataset_files(url)
    return Dataset(files, read_beside(files, decode_manifest))


def read_beside(files: DatasetFiles, decode: Callable[[BinaryIO, str], Manifest]) -> Manifest:
    """Return what `decode` finds in the manifest; raises as `open_dataset`."""
    stream = files.open_beside("manifest.json")
    if stream is None:
        is_there = not isinstance(files, LocalFiles) or files.root.exists()
        raise missing_manifest(files.shown, is_there=is_there)
    with stream:
        return decode(stream, f"{files.shown}/manifest.json")
