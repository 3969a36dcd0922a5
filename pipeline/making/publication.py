"""The manifest of a dataset that is made: begun, compared, and listed when all shards are there."""

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
from storage.claims import claimed
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

_LOOKS = 7
"""For a shard that a worker says it has packed; network file systems may show it a minute later."""


@dataclass(frozen=True, kw_only=True)
class Done:
    """What is finished of the shards that were asked for."""

    shards: int = 0
    """Shards that are there."""
    scenes: int = 0
    """Scenes for which they stand, given-up ones included."""
    shards_asked: int = 0
    """Shards that were asked for."""
    scenes_asked: int = 0
    """Their scenes."""
    given_up: int = 0
    """Scenes of this run that could not be made; of all runs once the dataset is finished."""


class Publication:
    """What is public of a dataset, shared by all who make it.

    Until all shards are there the manifest is a head of a few kilobytes, and each shard has a note:
    a maker writes what it has made, and reads no more than it asks for. Every change of the
    manifest is made in turn, to what is on the disk then, and reaches the disk before the call
    returns.
    """

    def __init__(self, folder: DatasetFolder, manifest: Manifest, splits: SplitSettings) -> None:
        self.folder = folder
        self.manifest = manifest
        """What the dataset is; its shards are listed once it is finished."""
        self.done = Done()
        """What is finished of what was asked for, as far as this maker has looked."""
        self.failures: list[Failure] = []
        """What was rejected on the way to the shards of this run, until the manifest lists them."""
        self.left_to_others = False
        """Whether another machine has just listed the shards, and writes the documents."""
        self._splits = splits

    @property
    def splits(self) -> SplitSettings:
        """How scenes are divided, as far as they are planned: the last shard may hold fewer."""
        return cut_splits(self.manifest.num_scenes, self._splits)

    def dataset(self) -> Dataset:
        """Return what is public, for whoever reads it."""
        return open_dataset(str(self.folder.root))

    def send_documents(self) -> None:
        """Bring the documents of the folder to where the dataset is: here they are."""

    @property
    def num_shards(self) -> int:
        """How many shards the dataset will have."""
        return shards_for(self.manifest.num_scenes, self._splits)

    def lock_objects(self, objects: list[LockedObject]) -> None:
        """Freeze the objects of the dataset."""
        lock = encode_objects_lock(objects)
        with self._turn():
            write_atomically(self.folder.objects_lock, lock)
            self._write(objects_lock_sha256=sha256_hex(lock))

    def take_lock(self) -> None:
        """Have the lock and its index here, where another machine has frozen the objects."""

    def claim(self, path: Path) -> contextlib.AbstractContextManager[bool]:
        """Hold the claim on a file that one worker makes; yield whether it is ours.

        Where it is, another worker may have made the file in the meantime.
        """
        return claimed(path.with_suffix(".claim"))

    def send(self, path: Path) -> None:
        """Bring a file of the folder to where the dataset is: here it is."""

    def has(self, path: Path) -> bool:
        """Return whether a file of the folder is where the dataset is."""
        return path.exists()

    def add_shard(self, shard: ShardEntry) -> None:
        """Note a finished shard.

        Raises:
            TrilightError: it is not here, so that its maker works in another folder.
        """
        self._require_here(shard.name)
        failures = read_failures(rejections_of_shard(self.folder, shard.name))
        self._note(ShardNote(shard=shard, failures=tuple(failures)))

    def _note(self, note: ShardNote) -> None:
        note_shard(self.folder, note)
        self._count(note)

    def _count(self, note: ShardNote) -> None:
        num_scenes = self._num_scenes([number_of_shard(note.shard)])
        self.failures += note.failures
        self.done = dataclasses.replace(
            self.done,
            shards=self.done.shards + 1,
            scenes=self.done.scenes + num_scenes,
            given_up=self.done.given_up + num_scenes - note.shard.num_samples,
        )

    def missing_shards(self, wanted: range | None = None) -> list[int]:
        """Return which of the wanted shards are still to make or to grow; of all by default.

        What that costs depends on what is wanted alone.
        """
        self.refresh()  # somebody may have planned more
        every = range(self.num_shards)
        asked = every if wanted is None else every[wanted.start : wanted.stop]
        missing = self._missing(asked)
        self.done = dataclasses.replace(
            self.done,
            shards=len(asked) - len(missing),
            scenes=self._num_scenes(asked) - self._num_scenes(missing),
            shards_asked=len(asked),
            scenes_asked=self._num_scenes(asked),
        )
        return missing

    def _missing(self, shards: range) -> list[int]:
        there = self._shards_there(shards)
        return [index for index in shards if shard_name(index, self._splits) not in there]

    def _num_scenes(self, shards: Iterable[int]) -> int:
        splits = self.splits
        return sum(len(scenes_of_shard(index, splits)) for index in shards)

    def _shards_there(self, shards: range) -> set[str]:
        """Return names of whole shards where the dataset is, at least those that are asked."""
        return {
            name
            for part in parts_of(shards)
            for name in shard_names_in_part(self.folder.root, part)
            if name not in self.manifest.growing
        }

    def num_shards_there(self) -> int:
        """Return how many shards are there, as far as is known here."""
        names = shard_names_in(self.folder.root)
        return sum(name not in self.manifest.growing for name in names)

    def _are_all_there(self) -> bool:
        """Return whether every shard is there; looks part by part, up to the first that is not."""
        parts = list(in_parts(range(self.num_shards)))
        if any(len(self._shards_there(part)) < len(part) for part in parts):  # names cost more
            return False
        return not any(map(self._missing, parts))

    def finish(self) -> Manifest | None:
        """List all shards in the manifest, and their rejections, if all are there; return it.

        Raises:
            TrilightError: a shard is damaged, or the folder cannot be written.
        """
        self.refresh()
        if not self._are_all_there():
            return None
        with self._turn():  # somebody may have planned more
            if not self._are_all_there():
                return None
            listed = read_manifest(self.folder.manifest)
            if (notes := self._unlisted(listed)) or listed.growing:
                shards = {entry.name: entry for entry in listed.shards}
                shards |= {note.shard.name: note.shard for note in notes}
                every = tuple(sorted(shards.values(), key=number_of_shard))
                self._add_failures(failure for note in notes for failure in note.failures)
                listed = dataclasses.replace(listed, shards=every, growing=(), documents={})
                write_manifest(self.folder.manifest, listed)
            for staged in (self.folder.staged_entries, self.folder.staged_failures):
                shutil.rmtree(staged, ignore_errors=True)
            self.folder.staged_given_up.unlink(missing_ok=True)
        num_scenes, self.failures = self._num_scenes(range(self.num_shards)), []
        given_up = num_scenes - listed.num_samples
        self.manifest = listed
        self.done = dataclasses.replace(self.done, given_up=given_up)
        return listed

    def _unlisted(self, listed: Manifest) -> list[ShardNote]:
        """Return what is known of every shard that is not in a manifest, or has been made anew."""
        known = {entry.name for entry in listed.shards} - set(noted_names(self.folder))
        every = (shard_name(index, self._splits) for index in range(self.num_shards))
        return [noted_shard(self.folder, name) for name in every if name not in known]

    def extend(self, num_scenes: int) -> None:
        """Plan more scenes; call in the turn of the manifest.

        A last shard that is there with fewer scenes than fit grows from now on: in the turn, each
        shard of a folder holds what is planned for it, or else the manifest says that it grows.
        """
        growing, last = set(self.manifest.growing), self.num_shards - 1
        name, scenes = shard_name(last, self._splits), scenes_of_shard(last, self.splits)
        if scenes != scenes_of_shard(last, self._splits):
            (self.folder.staged_sent / name).unlink(missing_ok=True)  # of a bucket: looked at again
            if self.folder.shard(name).exists() and name not in growing:
                unpack_here(self.folder, name, scenes, read_manifest(self.folder.manifest))
                growing.add(name)
        self._write(num_scenes=num_scenes, growing=tuple(sorted(growing)), documents={})

    def add_failures(self, failures: Iterable[Failure]) -> None:
        """Add rows to `failures.jsonl`; a row that is there already stays single."""
        with self._turn():
            self._add_failures(failures)

    def _has(self, name: str) -> bool:
        """Return whether a shard that somebody has packed can be seen."""
        return self.folder.has_shard(name)

    def _require_here(self, name: str) -> None:
        for look in range(_LOOKS):
            if self._has(name):
                return
            time.sleep(2**look if look < _LOOKS - 1 else 0)
        raise TrilightError(
            f"{self.folder.shown}: a worker has packed {name}, and it is not here: the worker's "
            "folder is not this one. Expected workers that see the same --out at the same place "
            "(for a bucket, the same TRILIGHT_CACHE); share it, and run the same command again."
        )

    def refresh(self) -> None:
        """Read what other makers have written of the dataset as such.

        Raises:
            TrilightError: another dataset has been begun in the folder since.
        """
        found = read_head(self.folder.manifest)
        if found.settings != self.manifest.settings:
            raise TrilightError(
                f"{self.folder.shown}: another dataset has been begun here in the meantime; choose "
                "another --out."
            )
        self.manifest = found

    @contextlib.contextmanager
    def _turn(self) -> Iterator[None]:
        with self.folder.turn("manifest"):
            self.refresh()
            yield

    def _add_failures(self, failures: Iterable[Failure]) -> None:
        known = read_failures(self.folder.failures)
        write_failures(self.folder.failures, [*known, *failures])

    def _write(self, **changes: Any) -> None:
        whole = read_manifest(self.folder.manifest)  # a finished set that grows has shards
        write_manifest(self.folder.manifest, dataclasses.replace(whole, **changes))
        self.manifest = dataclasses.replace(self.manifest, **changes)
