"""`DatasetWriter`: publishes shards and writes the manifest of a dataset in a folder."""

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.shards.pack import unpack_here
from storage.atomic import write_atomically
from storage.claims import hold_claim
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import (
    DatasetFolder,
    in_parts,
    parts_of,
    shard_names_in,
    shard_names_in_part,
)
from storage.dataset.manifest import (
    Manifest,
    ShardEntry,
    number_of_shard,
    read_head,
    read_manifest,
    write_manifest,
)
from storage.dataset.settings import SplitSettings
from storage.dataset.shard_notes import (
    ShardNote,
    note_shard,
    noted_names,
    noted_shard,
    rejections_of_shard,
)
from storage.dataset.splits import cut_splits, scenes_of_shard, shard_name, shards_for
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import (
    Failure,
    LockedObject,
    encode_objects_lock,
    read_failures,
    write_failures,
)

_MAX_LOOKS = 7
"""Looks for a shard that a worker has packed; network file systems may show it a minute later."""


@dataclass(frozen=True, kw_only=True)
class DatasetProgress:
    """Progress of the requested shards."""

    shards: int = 0
    """Finished shards among the requested ones."""
    scenes: int = 0
    """Scenes of the finished shards, given-up ones included."""
    shards_requested: int = 0
    """Shards that this run requested."""
    scenes_requested: int = 0
    """Scenes of the requested shards."""
    given_up: int = 0
    """Scenes of this run that could not be made; of all runs once the dataset is finished."""


class DatasetWriter:
    """Writes the published files of a dataset, together with its other workers.

    Until all shards are finished the manifest is a head of a few kilobytes, and each shard has a
    note: a worker writes notes on its own shards, and reads only those of the requested ones. Every
    change of the manifest holds its mutex, applies to the file on disk at that moment, and reaches
    the disk before the call returns.
    """

    def __init__(self, folder: DatasetFolder, manifest: Manifest, splits: SplitSettings) -> None:
        self.folder = folder
        self.manifest = manifest
        """Manifest of the dataset; it lists shards only once the dataset is finished."""
        self.progress = DatasetProgress()
        """Progress of the requested shards, at this worker's last look."""
        self.failures: list[Failure] = []
        """Rejections of this run's scenes, until the manifest lists their shards."""
        self.left_to_others = False
        """True if another machine has just listed the shards, and writes the documents."""
        self._splits = splits

    @property
    def splits(self) -> SplitSettings:
        """Split settings, cut to the planned scenes: the last shard may hold fewer."""
        return cut_splits(self.manifest.num_scenes, self._splits)

    def dataset(self) -> Dataset:
        """Return a reader of the published dataset."""
        return open_dataset(str(self.folder.root))

    def upload_documents(self) -> None:
        """Upload the documents; no-op for a local folder."""

    @property
    def num_shards(self) -> int:
        """Number of shards of the finished dataset."""
        return shards_for(self.manifest.num_scenes, self._splits)

    def lock_objects(self, objects: list[LockedObject]) -> None:
        """Freeze the objects of the dataset: write their lock file and its digest."""
        lock = encode_objects_lock(objects)
        with self._lock_manifest():
            write_atomically(self.folder.objects_lock, lock)
            self._write(objects_lock_sha256=sha256_hex(lock))

    def fetch_lock(self) -> None:
        """Download the lock and its index if another machine has frozen the objects."""

    def claim(self, path: Path) -> contextlib.AbstractContextManager[bool]:
        """Hold the claim on a file that one worker makes; yield True if this worker holds it.

        Another worker may have made the file in the meantime.
        """
        return hold_claim(path.with_suffix(".claim"))

    def upload(self, path: Path) -> None:
        """Upload a file of the folder; no-op for a local folder."""

    def has(self, path: Path) -> bool:
        """Return True if a file of the folder is published."""
        return path.exists()

    def add_shard(self, shard: ShardEntry) -> None:
        """Record a finished shard.

        Raises:
            TrilightError: it is not here, so that its worker uses another folder.
        """
        self._require_visible(shard.name)
        failures = read_failures(rejections_of_shard(self.folder, shard.name))
        self._note(ShardNote(shard=shard, failures=tuple(failures)))

    def _note(self, note: ShardNote) -> None:
        note_shard(self.folder, note)
        self._count(note)

    def _count(self, note: ShardNote) -> None:
        num_scenes = self._num_scenes([number_of_shard(note.shard)])
        self.failures += note.failures
        self.progress = dataclasses.replace(
            self.progress,
            shards=self.progress.shards + 1,
            scenes=self.progress.scenes + num_scenes,
            given_up=self.progress.given_up + num_scenes - note.shard.num_samples,
        )

    def unfinished_shards(self, requested: range | None = None) -> list[int]:
        """Return the unfinished or growing shards among the requested ones; by default of all.

        The cost depends on the number of requested shards alone.
        """
        self.refresh()  # another run may have planned more
        every = range(self.num_shards)
        selected = every if requested is None else every[requested.start : requested.stop]
        missing = self._missing(selected)
        self.progress = dataclasses.replace(
            self.progress,
            shards=len(selected) - len(missing),
            scenes=self._num_scenes(selected) - self._num_scenes(missing),
            shards_requested=len(selected),
            scenes_requested=self._num_scenes(selected),
        )
        return missing

    def _missing(self, shards: range) -> list[int]:
        finished = self._finished_shards(shards)
        return [index for index in shards if shard_name(index, self._splits) not in finished]

    def _num_scenes(self, shards: Iterable[int]) -> int:
        splits = self.splits
        return sum(len(scenes_of_shard(index, splits)) for index in shards)

    def _finished_shards(self, shards: range) -> set[str]:
        """Return the names of finished shards: at least all finished ones of a range."""
        return {
            name
            for part in parts_of(shards)
            for name in shard_names_in_part(self.folder.root, part)
            if name not in self.manifest.growing
        }

    def num_finished_shards(self) -> int:
        """Return the number of finished shards, as far as this machine knows."""
        names = shard_names_in(self.folder.root)
        return sum(name not in self.manifest.growing for name in names)

    def _is_complete(self) -> bool:
        """Return True if every shard is finished; stops at the first part that is not."""
        parts = list(in_parts(range(self.num_shards)))
        if any(len(self._finished_shards(part)) < len(part) for part in parts):  # names cost more
            return False
        return not any(map(self._missing, parts))

    def finish(self) -> Manifest | None:
        """List all shards in the manifest if all are finished, and return it; else None.

        Raises:
            TrilightError: a shard is damaged, or the folder cannot be written.
        """
        self.refresh()
        if not self._is_complete():
            return None
        with self._lock_manifest():  # another run may have planned more
            if not self._is_complete():
                return None
            listed = read_manifest(self.folder.manifest)
            if (notes := self._unlisted_notes(listed)) or listed.growing:
                shards = {entry.name: entry for entry in listed.shards}
                shards |= {note.shard.name: note.shard for note in notes}
                every = tuple(sorted(shards.values(), key=number_of_shard))
                self._add_failures(failure for note in notes for failure in note.failures)
                listed = dataclasses.replace(listed, shards=every, growing=(), documents={})
                write_manifest(self.folder.manifest, listed)
            for staged in (self.folder.staged_entries, self.folder.staged_failures):
                shutil.rmtree(staged, ignore_errors=True)
            self.folder.staged_given_up.unlink(missing_ok=True)
        num_scenes = self._num_scenes(range(self.num_shards))
        self.failures = []
        given_up = num_scenes - listed.num_samples
        self.manifest = listed
        self.progress = dataclasses.replace(self.progress, given_up=given_up)
        return listed

    def _unlisted_notes(self, listed: Manifest) -> list[ShardNote]:
        """Return the notes of all shards that a manifest does not list, or lists in an old form."""
        known = {entry.name for entry in listed.shards} - set(noted_names(self.folder))
        every = (shard_name(index, self._splits) for index in range(self.num_shards))
        return [noted_shard(self.folder, name) for name in every if name not in known]

    def extend(self, num_scenes: int) -> None:
        """Plan more scenes; call while holding the mutex of the manifest.

        A last shard that is not full grows from now on. While the mutex is held, each shard of a
        folder holds its planned scenes, or else the manifest lists it as growing.
        """
        growing = set(self.manifest.growing)
        last = self.num_shards - 1
        name = shard_name(last, self._splits)
        scenes = scenes_of_shard(last, self.splits)
        if scenes != scenes_of_shard(last, self._splits):
            (self.folder.staged_sent / name).unlink(missing_ok=True)  # of a bucket: looked at again
            if self.folder.shard(name).exists() and name not in growing:
                unpack_here(self.folder, name, scenes, read_manifest(self.folder.manifest))
                growing.add(name)
        self._write(num_scenes=num_scenes, growing=tuple(sorted(growing)), documents={})

    def add_failures(self, failures: Iterable[Failure]) -> None:
        """Add rows to `failures.jsonl`, without duplicates."""
        with self._lock_manifest():
            self._add_failures(failures)

    def _sees_shard(self, name: str) -> bool:
        """Return True if a packed shard is visible here."""
        return self.folder.has_shard(name)

    def _require_visible(self, name: str) -> None:
        for look in range(_MAX_LOOKS):
            if self._sees_shard(name):
                return
            time.sleep(2**look if look < _MAX_LOOKS - 1 else 0)
        raise TrilightError(
            f"{self.folder.display_name}: a worker has packed {name}, and it is not here: the "
            "worker's "
            "folder is not this one. Expected workers that see the same --out at the same place "
            "(for a bucket, the same TRILIGHT_CACHE); share it, and run the same command again."
        )

    def refresh(self) -> None:
        """Read the head of the manifest again, as other workers may have changed it.

        Raises:
            TrilightError: another dataset has been begun in the folder since.
        """
        head = read_head(self.folder.manifest)
        if head.settings != self.manifest.settings:
            raise TrilightError(
                f"{self.folder.display_name}: another dataset has been begun here in the meantime; "
                "choose "
                "another --out."
            )
        self.manifest = head

    @contextlib.contextmanager
    def _lock_manifest(self) -> Iterator[None]:
        with self.folder.mutex("manifest"):
            self.refresh()
            yield

    def _add_failures(self, failures: Iterable[Failure]) -> None:
        known = read_failures(self.folder.failures)
        write_failures(self.folder.failures, [*known, *failures])

    def _write(self, **changes: Any) -> None:
        manifest = read_manifest(self.folder.manifest)  # a finished set that grows has shards
        write_manifest(self.folder.manifest, dataclasses.replace(manifest, **changes))
        self.manifest = dataclasses.replace(self.manifest, **changes)
