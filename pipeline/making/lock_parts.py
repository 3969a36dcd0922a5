"""The parts in which a dataset's objects are frozen: one, or as many as `splits.object_parts` says.

Scene k is a function of the settings, the lock and k, and nothing may change what it draws from
once it may have been made. With one part, that asks for all objects before the first scene. With
several, an object's part follows from its uid and a shard's part from its number, whatever else
there is. The lock grows by whole parts, and a part that has rows in it never changes. So the first
scenes wait for the first part alone, and each of them is still a function of the finished lock: it
draws from the rows of its part. Each prefix of such a dataset is a dataset that verifies.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.making.publication import Publication
from storage.dataset.layout import DatasetFolder
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import part_of_object, part_of_shard
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.objects import (
    LockedObject,
    encode_objects_lock,
    read_objects_lock,
    write_objects_lock,
)


@dataclass(frozen=True, kw_only=True)
class LockPart:
    """What of a lock is frozen at once; by default all of it."""

    folder: DatasetFolder
    """The dataset."""
    splits: SplitSettings
    """How its objects and shards are divided."""
    number: int | None = None
    """Of the part, from 0; None for the whole lock."""

    @property
    def lock(self) -> Path:
        """File with the rows of this part alone, for those who draw from it."""
        if self.number is None:
            return self.folder.objects_lock
        return self.folder.staged_locks / f"{self.number:04d}.lock.jsonl"

    @property
    def index(self) -> Path:
        """The index of that file."""
        if self.number is None:
            return self.folder.staged_index
        return self.folder.staged_locks / f"{self.number:04d}.index"

    def holds(self, uid: str) -> bool:
        """Return whether an object belongs to this part."""
        return self.number is None or part_of_object(uid, self.splits) == self.number

    def has_shard(self, shard_index: int) -> bool:
        """Return whether a shard draws from this part."""
        return self.number is None or part_of_shard(shard_index, self.splits) == self.number

    def frozen(self, publication: Publication) -> dict[str, LockedObject] | None:
        """Return what is frozen of this part by uid, or None where nothing is yet."""
        if not publication.manifest.objects_lock_sha256:
            return None
        rows = read_objects_lock(self.folder.objects_lock)
        here = {entry.uid: entry for entry in rows if self.holds(entry.uid)}
        if self.number is None:
            return here
        others = encode_objects_lock(entry for entry in rows if entry.uid not in here)
        if sha256_hex(others) == publication.manifest.objects_lock_sha256:
            return None  # a kill came between the lock and the manifest, or nothing is there yet
        return here or None

    def freeze(self, publication: Publication, locked: Sequence[LockedObject]) -> None:
        """Freeze the objects of this part, beside those of others."""
        others: list[LockedObject] = []
        if self.number is not None and publication.manifest.objects_lock_sha256:
            rows = read_objects_lock(self.folder.objects_lock)
            others = [entry for entry in rows if not self.holds(entry.uid)]
        publication.lock_objects([*others, *locked])

    def write_rows(self, locked: Sequence[LockedObject]) -> None:
        """Write the file of this part's own rows, where the lock itself is not that."""
        if self.number is not None:
            write_objects_lock(self.lock, locked)

    def is_public(self, publication: Publication, sha256: str) -> bool:
        """Return whether the rows of this part, which have a digest, are in the dataset's lock."""
        frozen = publication.manifest.objects_lock_sha256
        if self.number is None or not frozen:
            return frozen == sha256
        first = LockRows(self.lock).at(0)
        return LockRows(self.folder.objects_lock).find(first.uid) == first

    def num_frozen(self) -> int:
        """Return how many rows the dataset's lock has by now."""
        with self.folder.objects_lock.open("rb") as lines:
            return sum(1 for _ in lines)


def lock_parts(
    folder: DatasetFolder, splits: SplitSettings, shards: Sequence[int], *, maps: bool = False
) -> list[LockPart]:
    """Return the parts that some shards draw from, those of the first shards first.

    Raises:
        TrilightError: there are several, and the dataset is made in a bucket, or has textures or
            skies of the user's own (`maps`).
    """
    if splits.object_parts == 1:
        return [LockPart(folder=folder, splits=splits)]
    if folder.bucket:
        raise TrilightError(
            f"{folder.shown}: splits.object_parts is {splits.object_parts}; expected 1 for a "
            "dataset in a bucket, whose lock appears once. Leave the setting away."
        )
    if maps:
        raise TrilightError(
            f"splits.object_parts is {splits.object_parts}; expected 1 beside --textures or "
            "--skies, which are frozen with all objects. Leave one of them away."
        )
    numbers = dict.fromkeys(part_of_shard(index, splits) for index in shards)
    return [LockPart(folder=folder, splits=splits, number=number) for number in numbers or [0]]
