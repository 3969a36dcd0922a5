"""A dataset that is read, in a folder of this machine or on a server: manifest, files, samples."""

import contextlib
import os
import shlex
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from storage.conventions import SPLITS
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, decode_manifest
from storage.dataset.shard import samples_of, with_maps
from storage.digests import sha256_of_stream
from storage.errors import TrilightError
from storage.records.held_maps import HeldMaps
from storage.records.objects import Failure, LockedObject, decode_failures, decode_objects_lock
from storage.records.safe_read import open_plain
from storage.records.sample import Sample, SceneRecord, decode_sample, decode_scene
from storage.remote.cache import shard_cache
from storage.remote.fetch import download, facts_of, unreadable
from storage.remote.tries import TransferFailed, is_missing
from storage.remote.url import RemoteUrl, parse_url

MAX_BESIDE_BYTES = 1 << 30
"""Largest file beside the shards: a manifest takes about 200 bytes a member."""


class _Files(ABC):
    """The files beside the shards."""

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
            checked: check its digest first, once as long as the file stays unchanged.

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
        """Open a shard for reading; its digest is always checked on arrival.

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


_OF_DAMAGED_BYTES = (ValueError, LookupError, TypeError, EOFError, zlib.error)


@contextlib.contextmanager
def reading(dataset: str, shard: str) -> Iterator[None]:
    """Turn any error of reading a shard into one sentence with the next step.

    Args:
        dataset: its place, for messages.
        shard: its name.

    Raises:
        TrilightError: the block raised one, or another error that damaged bytes cause.
    """
    try:
        yield
    except _OF_DAMAGED_BYTES as error:
        why = (
            str(error)
            if isinstance(error, TrilightError)
            else f"not as expected ({type(error).__name__})"
        )
        raise TrilightError(
            f"{shard}: {why.rstrip('.')}. The shard is damaged; run `trilight verify "
            f"{shlex.quote(dataset)} --repair`."
        ) from error


class Dataset:
    """The shards of one dataset, checked by digest as they are read."""

    def __init__(self, files: DatasetFiles, manifest: Manifest) -> None:
        self.files = files
        self.manifest = manifest

    @property
    def shown(self) -> str:
        """The place of the dataset for messages, without secrets."""
        return self.files.shown

    @property
    def folder(self) -> DatasetFolder:
        """The dataset's folder; raises TrilightError where it is on a server."""
        if isinstance(self.files, RemoteDatasetFiles):
            raise TrilightError(f"dataset {self.shown!r} is on a server; expected a local folder.")
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

        Raises:
            TrilightError: the file is missing or its bytes are not those of the manifest.
        """
        held = HeldMaps()
        with self.files.open(shard, checked=True) as stream:
            for key, members in samples_of(stream, shard.name):
                yield decode_sample(key, members, held)

    def read_scenes(self, shard: ShardEntry) -> Iterator[SceneRecord]:
        """Yield the samples of a shard without their pictures, through the manifest's index.

        Only what is needed is read, so that a large dataset can be browsed; the digest of the
        shard is therefore not checked (`read_shard` and `trilight verify` do that).

        Raises:
            TrilightError: the shard is missing or shorter than its index, or a scene in it is
                unreadable or breaks a law.
        """
        maps, held = shard.maps, HeldMaps()
        with self.files.open(shard, checked=False) as stream:
            for key, members in shard.index.items():
                scene_members = [suffix for suffix in members if not suffix.endswith("exr")]
                with reading(self.shown, shard.name):
                    found = _read(stream, members, scene_members, maps)
                    record = decode_scene(key, found, held)
                    _require_lawful(record)
                yield record

    def read_samples(self, shard: ShardEntry, keys: Iterable[str]) -> Iterator[Sample]:
        """Yield some samples of a shard with their pictures; otherwise as `read_scenes`."""
        index, maps, held = shard.index, shard.maps, HeldMaps()
        with self.files.open(shard, checked=False) as stream:
            for key in keys:
                with reading(self.shown, shard.name):
                    found = _read(stream, index[key], index[key], maps)
                    sample = decode_sample(key, found, held)
                    _require_lawful(sample)
                yield sample

    def objects_lock(self) -> list[LockedObject]:
        """Return the objects that were used; none where the dataset has no lock."""
        data = self.files.read("objects.lock.jsonl")
        return [] if data is None else decode_objects_lock(data, "objects.lock.jsonl")

    def failures(self) -> list[Failure]:
        """Return what was rejected; none where the dataset does not say."""
        return decode_failures(self.files.read("failures.jsonl") or b"")


def _read(
    stream: BinaryIO,
    index: Mapping[str, tuple[int, int]],
    suffixes: Iterable[str],
    maps: Mapping[str, tuple[int, int]],
) -> dict[str, bytes]:
    members = {suffix: _read_at(stream, index[suffix]) for suffix in suffixes}
    return with_maps(members, maps, lambda place: _read_at(stream, place))


def _read_at(stream: BinaryIO, place: tuple[int, int]) -> bytes:
    offset, num_bytes = place
    stream.seek(offset)
    data = stream.read(num_bytes)
    if len(data) != num_bytes:
        raise TrilightError("shorter than the manifest says")
    return data


def _require_lawful(record: SceneRecord | Sample) -> None:
    try:
        record.scene.check()
    except TrilightError as error:
        raise TrilightError(f"sample {record.key}: {error}") from error
    if record.scene.num_views != len(record.views):
        raise TrilightError(
            f"sample {record.key}: {len(record.views)} view records; expected "
            f"{record.scene.num_views}, one for each camera."
        )


def open_dataset(
    url: str, *, shard_read: Callable[[ShardEntry], ShardEntry] = lambda shard: shard
) -> Dataset:
    """Open the dataset in a local folder, or below a URL of http, https, s3, gs or hf.

    Args:
        url: where it is.
        shard_read: returns what is kept of each shard of the manifest (storage.dataset.manifest).

    Raises:
        TrilightError: there is no readable manifest, the URL is refused, or the driver for it is
            not installed.
    """
    files = dataset_files(url)
    stream = files.open_beside("manifest.json")
    if stream is None:
        raise TrilightError(
            f"{files.shown}: no manifest.json here; expected a dataset, as `trilight generate ... "
            "--out` makes it."
        )
    with stream:
        place = f"{files.shown}/manifest.json"
        return Dataset(files, decode_manifest(stream, place, shard_read))
