"""A dataset in a bucket that several machines make: each has a local folder of its own.

The bucket holds what a folder would hold. The manifest is begun once, the objects are frozen once,
and each shard is put there once: the server refuses a second writer, who takes what is there.
Below `.staging` stand for each shard the rejections of its scenes and a note with its manifest
entry. A shard is finished when it and its note are there, or the manifest lists it. The manifest
follows from what it was begun with and from the notes, so any worker may write it at any time.

Claims do not reach from one machine to another: two machines with the same shards make scenes
twice, and the first writer of a shard wins. That is wasted work, never wrong.
"""

import dataclasses
import json
import shutil
from collections.abc import Collection
from pathlib import Path

from pipeline.shards.pack import note_of, note_shard, noted_shard, rejections_of_shard
from storage.atomic import write_atomically
from storage.claims import claimed
from storage.dataset.dataset import Dataset, RemoteDatasetFiles
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import (
    SHARD_NAME,
    Manifest,
    ShardEntry,
    decode_manifest,
    index_stream,
    read_manifest,
    shard_of_row,
    write_manifest,
)
from storage.dataset.progress import log_name
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import decode_failures, read_failures, write_failures
from storage.remote.bucket import Bucket
from storage.remote.cache import shard_cache
from storage.remote.url import RemoteUrl, parse_url

_PLANNED = ".staging/planned/"
"""Folder with one file for each requested number of scenes; the largest counts."""


class Mirror:
    """Exchange between a machine's folder and the bucket."""

    def __init__(self, folder: DatasetFolder) -> None:
        url = parse_url(folder.bucket, what="out")
        assert isinstance(url, RemoteUrl)
        self._folder = folder
        self._bucket = Bucket(url)
        self._files = RemoteDatasetFiles(url)

    def names(self) -> set[str]:
        """Return the names of all files of the dataset."""
        return self._bucket.names()

    def dataset(self, manifest: Manifest) -> Dataset:
        """Return the dataset of a manifest, to be read from the bucket."""
        return Dataset(self._files, manifest)

    def adopt(self) -> None:
        """Bring the folder's published files in line with the bucket.

        Scenes that wait for their shard stay where they are of the same dataset; where the folder
        is of another one, or the bucket is empty, they go. Call while no other process holds it.

        Raises:
            TrilightError: the bucket cannot be read.
        """
        folder, theirs = self._folder, self._manifest()
        if theirs is None or _identity(self._own_manifest()) != _identity(theirs):
            _clear(folder)
        shutil.rmtree(folder.staged_sent, ignore_errors=True)  # `receive` looks again
        if theirs is None:
            return
        if (lock := self._files.read("objects.lock.jsonl")) is not None:
            write_atomically(folder.objects_lock, lock)
            index = self._files.read(self._name(folder.staged_index))
            if index is not None:
                write_atomically(folder.staged_index, index)
        self._take_failures()
        write_manifest(folder.manifest, theirs)

    def begin(self) -> bool:
        """Create the bucket's manifest from the folder's; return whether ours came first."""
        return self._bucket.create("manifest.json", self._folder.manifest)

    def plan(self, num_scenes: int) -> None:
        """Tell all workers how many scenes the dataset is to have."""
        self._bucket.write(f"{_PLANNED}{num_scenes:012d}", b"\n")

    def freeze(self, lock: bytes) -> None:
        """Put the frozen objects into the bucket, after what was rejected for them.

        What others have rejected in the meantime stays.

        Raises:
            TrilightError: another worker has frozen other objects in the meantime.
        """
        name = self._folder.objects_lock.name
        theirs = self._files.read(name)
        if theirs in (None, lock):
            with self._folder.turn("manifest"):
                self._take_failures()
                self._bucket.write("failures.jsonl", self._folder.failures)
        if theirs is None and not self._bucket.create(name, lock):
            theirs = self._files.read(name)
        if theirs not in (None, lock):
            raise TrilightError(
                f"{self._folder.shown}: another worker has frozen other objects in the meantime; "
                "expected the same --objects everywhere. Give that, or choose another --out."
            )

    def receive(self, listed: Collection[str]) -> tuple[int, int]:
        """Read what other workers have finished and planned.

        Args:
            listed: names of the shards that the folder's manifest lists.

        Returns:
            The number of new shards, and of the scenes of the dataset.
        """
        names, new = self.names(), 0
        for name in sorted(filter(SHARD_NAME.fullmatch, names)):
            note = self._name(note_of(self._folder, name))
            if self._folder.is_sent(name) or not (name in listed or note in names):
                continue
            if name not in listed:
                self._take_note(name, note)
                new += 1
            self._mark(name)
        planned = [name.removeprefix(_PLANNED) for name in names if name.startswith(_PLANNED)]
        return new, max((int(text) for text in planned if text.isdecimal()), default=0)

    def send(self, name: str, made: ShardEntry | None = None) -> ShardEntry | None:
        """Bring a shard of the folder into the bucket; the cache keeps its bytes.

        Args:
            name: of the shard.
            made: its entry, where that is known.

        Returns:
            The entry of the shard that is in the bucket then, ours or that of the first writer;
            None where another process of this machine sends it, or has sent it.
        """
        folder, path = self._folder, self._folder.shard(name)
        with claimed(folder.staging / "sending" / f"{name}.claim") as ours:
            if not ours or not path.exists():
                return None
            entry = made = made or noted_shard(folder, name)
            if not folder.is_sent(name):
                entry = self._put(made)
                self._mark(name)
            if entry == made:
                shard_cache().keep(path, self._files.url.child(name), entry.sha256)
            path.unlink(missing_ok=True)
        return entry

    def _put(self, made: ShardEntry) -> ShardEntry:
        """Put a shard and what stands beside it into the bucket; return the entry of what is there.

        A worker that was not first takes over the first writer's rejections. Where those are
        missing, the first writer was killed, and ours are stored instead.
        """
        folder, name = self._folder, made.name
        log, rejections = folder.root / log_name(name), rejections_of_shard(folder, name)
        if self._bucket.create(name, folder.shard(name)):
            if log.exists():
                self._bucket.write(self._name(log), log)
            entry = made
            self._bucket.write(self._name(rejections), rejections)
        else:
            url = self._files.url.child(name)
            with shard_cache().open(url, num_bytes=None, sha256=None) as stream:
                entry = index_stream(stream, Path(name).name)
            if not self._bucket.create(self._name(rejections), rejections):
                self._take_rejections(name)
        note_shard(folder, entry)
        note = note_of(folder, name)
        self._bucket.write(self._name(note), note)
        return entry

    def send_index(self) -> None:
        """Put the index of the frozen objects into the bucket: others trust the lock by it."""
        self._bucket.write(self._name(self._folder.staged_index), self._folder.staged_index)

    def send_manifest(self) -> None:
        """Put the folder's manifest and rejections into the bucket, in place of those there."""
        with self._folder.turn("manifest"):
            self._bucket.write("failures.jsonl", self._folder.failures)
            self._bucket.write("manifest.json", self._folder.manifest)

    def send_documents(self) -> None:
        """Put the documents for people and hubs into the bucket, the card last."""
        folder = self._folder
        documents = [
            *(folder.attribution, folder.licences, folder.contact_sheet, folder.report),
            *sorted(path for path in folder.report_pages.rglob("*") if path.is_file()),
            *(folder.croissant, folder.card),
        ]
        for path in documents:
            self._bucket.write(self._name(path), path)

    def _manifest(self) -> Manifest | None:
        """Return the manifest of the bucket with the digest of the objects that are there."""
        stream = self._files.open_beside("manifest.json") if self.names() else None
        if stream is None:
            return None
        with stream:
            manifest = decode_manifest(stream, f"{self._folder.shown}/manifest.json")
        lock = self._files.read(self._folder.objects_lock.name)
        return dataclasses.replace(manifest, objects_lock_sha256=sha256_hex(lock) if lock else "")

    def _take_failures(self) -> None:
        """Merge the bucket's rejections into the folder's."""
        theirs = decode_failures(self._files.read("failures.jsonl") or b"")
        known = read_failures(self._folder.failures)
        write_failures(self._folder.failures, [*known, *theirs])

    def _own_manifest(self) -> Manifest | None:
        try:
            return read_manifest(self._folder.manifest)
        except TrilightError:
            return None

    def _take_note(self, name: str, note: str) -> None:
        """Copy another worker's note on a shard into the folder."""
        try:
            entry = shard_of_row(json.loads(self._files.read(note) or b""))
            if entry.name != name:
                raise ValueError(entry.name)
        except (ValueError, KeyError, TypeError) as error:
            raise TrilightError(
                f"{self._folder.shown}/{note}: not a note on {name} ({error}); delete both, and "
                "the shard is made again."
            ) from error
        self._take_rejections(name)
        note_shard(self._folder, entry)

    def _take_rejections(self, name: str) -> None:
        rejections = rejections_of_shard(self._folder, name)
        failures = self._files.read(self._name(rejections))
        write_failures(rejections, decode_failures(failures or b""))

    def _mark(self, name: str) -> None:
        """Note that a shard is in the bucket."""
        write_atomically(self._folder.staged_sent / name, b"")

    def _name(self, path: Path) -> str:
        return path.relative_to(self._folder.root).as_posix()


def _identity(manifest: Manifest | None) -> object:
    """Return what scenes that are not in a shard yet depend on."""
    if manifest is None:
        return None
    return (
        manifest.settings,
        manifest.environment,
        manifest.objects_lock_sha256,
        manifest.extensions,
    )


def _clear(folder: DatasetFolder) -> None:
    """Delete everything in a folder except the locks of its workers."""
    kept = {folder.staging, folder.staging / "lock", folder.staging / "turns"}
    for path in {*folder.root.iterdir(), *folder.staging.iterdir()} - kept:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
