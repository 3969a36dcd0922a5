"""A dataset that is read, in a folder of this machine or on a server: manifest, files, samples."""

import contextlib
import shlex
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, TypeVar

from storage.conventions import SPLITS
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, decode_manifest, missing_manifest
from storage.dataset.shard import ShardReader
from storage.errors import EnvironmentFailure, ShardMissing, TrilightError, Unreadable
from storage.records.objects import Failure, LockedObject, decode_failures
from storage.records.sample import (
    Sample,
    SceneRecord,
    decode_sample,
    decode_scene,
    require_lawful,
)
from storage.remote.store import WRITABLE, LocalStore, RemoteStore, Store
from storage.remote.url import parse_url
from storage.typed_json import read_json_lines

Record = TypeVar("Record", bound=SceneRecord)


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
            f"{shard}: {why.removeprefix(f'{shard}: ').rstrip('.')}. The shard is damaged; "
            f"`trilight verify {shlex.quote(dataset)}` says how to repair it."
        ) from error


class Dataset:
    """The shards of one dataset, checked by digest as they are read."""

    def __init__(
        self,
        store: Store,
        manifest: Manifest,
        num_listed: int | None = None,
        noted: Sequence[Failure] = (),
    ) -> None:
        """Name what is read.

        Args:
            store: where it is.
            manifest: what it is, with every shard that may be read.
            num_listed: how many of the shards the manifest on the disk lists; all by default.
            noted: what was rejected on the way to the others.
        """
        self.store = store
        self.manifest = manifest
        self.num_listed = len(manifest.shards) if num_listed is None else num_listed
        self._noted = noted

    @property
    def display_name(self) -> str:
        """The place of the dataset for messages, without secrets."""
        return self.store.display_name

    @property
    def folder(self) -> DatasetFolder:
        """The dataset's folder; raises TrilightError where it is on a server."""
        if (folder := self.local) is None:
            raise TrilightError(
                f"dataset {self.display_name!r} is on a server; expected a local folder."
            )
        return folder

    @property
    def local(self) -> DatasetFolder | None:
        """The dataset's folder; None where it is on a server."""
        return DatasetFolder(self.store.root) if isinstance(self.store, LocalStore) else None

    def names_in_bucket(self) -> set[str]:
        """Return the names of all files of a bucket that may be listed; of another place, none."""
        return self.store.list_all() if isinstance(self.store, RemoteStore) else set()

    @property
    def digest(self) -> str:
        """The dataset digest (storage.dataset.manifest)."""
        return self.manifest.dataset_digest

    def shards_of(self, split: str | None) -> list[ShardEntry]:
        """Return the shards of one split, or of all, by name."""
        if split not in (None, *SPLITS):
            raise TrilightError(f"split is {split!r}; expected one of {', '.join(SPLITS)}.")
        return [shard for shard in self.manifest.shards if split in (None, shard.split)]

    def scenes(self, split: str | None = None) -> Iterator[SceneRecord]:
        """Yield the scenes of a split, or of all, without their pictures; as `read_scenes`."""
        for shard in self.shards_of(split):
            yield from self.read_scenes(shard)

    def samples(self, split: str | None = None) -> Iterator[Sample]:
        """Yield the scenes of a split, or of all, with their pictures, as `read_shard` does.

        `sample.radiance_rgb` is [V, R, R, 3] float32 linear radiance of the cameras of
        `sample.scene`, and `sample.views` says of each how it was rendered, and its error.
        """
        for shard in self.shards_of(split):
            yield from self.read_shard(shard)

    def read_shard(self, shard: ShardEntry) -> Iterator[Sample]:
        """Yield the samples of a shard in the order of the file, after checking its digest.

        It raises TrilightError where the file is missing or its bytes are not those of the
        manifest.
        """
        with self.open_shard(shard, checked=True) as opened:
            for key, members in opened:
                yield decode_sample(key, members)

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
        decode: Callable[[str, Mapping[str, bytes]], Record],
        accepts: Callable[[str], bool] = lambda suffix: True,
    ) -> Iterator[Record]:
        with self.open_shard(shard) as opened:
            for key in opened.samples if keys is None else keys:
                with reading(self.display_name, shard.name):
                    record = decode(key, opened.members(key, accepts))
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
        stream = self.open_stream(shard, checked=checked)
        with reading(self.display_name, shard.name):
            return ShardReader(stream, shard.name)

    def open_stream(self, shard: ShardEntry, *, checked: bool) -> BinaryIO:
        """Open the file of a shard; as `Store.open_shard`."""
        return self.store.open_shard(
            shard.name, num_bytes=shard.num_bytes, sha256=shard.sha256, checked=checked
        )

    def lock_bytes(self) -> bytes | None:
        """Return the file of the objects that were used, or None where the dataset has none."""
        return self.store.get("objects.lock.jsonl")

    def objects_lock(self) -> list[LockedObject]:
        """Return the objects that were used; none where the dataset has no lock."""
        return read_json_lines(self.lock_bytes() or b"", LockedObject, "objects.lock.jsonl")

    def failures(self) -> list[Failure]:
        """Return what was rejected; none where the dataset does not say."""
        return [*decode_failures(self.store.get("failures.jsonl") or b""), *self._noted]


def open_dataset(url: str) -> Dataset:
    """Open the dataset in a local folder, or below a URL of http, https, s3, gs or hf.

    Of one that is still made, the shards that are noted so far count too, where the folder or
    bucket can be listed. It raises TrilightError where there is no readable manifest, the URL is
    refused, or the driver for it is not installed.
    """
    dataset = open_listed(url)
    store = dataset.store
    if isinstance(store, RemoteStore):
        may_be_growing = store.url.scheme in WRITABLE
    else:
        may_be_growing = dataset.folder.staged_entries.exists()
    if not may_be_growing:
        return dataset
    # slow, and not needed to stream a whole set
    from storage.dataset.staging import with_unlisted

    return with_unlisted(dataset)


def open_listed(url: str) -> Dataset:
    """Open what the manifest lists of a dataset: nothing while it is made; as `open_dataset`."""
    place = parse_url(url, what="dataset")
    store = LocalStore(place) if isinstance(place, Path) else RemoteStore(place)
    return Dataset(store, published_manifest(store))


def published_manifest(store: Store) -> Manifest:
    """Return the manifest of a dataset in a store; raises as `open_dataset`."""
    data = store.get("manifest.json")
    if data is None:
        is_there = not isinstance(store, LocalStore) or store.root.exists()
        raise missing_manifest(store.display_name, is_there=is_there)
    return decode_manifest(data, f"{store.display_name}/manifest.json")
