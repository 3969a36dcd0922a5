"""The parts in which a dataset's objects are frozen: one, or as many as `splits.object_parts` says.

Scene k is a function of the settings, the lock and k, and nothing may change what it draws from
once it may have been made. With one part, that asks for all objects before the first scene. With
several, an object's part follows from its uid and a shard's part from its number, whatever else
there is. Each part is a file of its own, written once, in a bucket by whichever machine is first;
the lock is made of them. So the first scenes wait for the first part alone, and each of them is
still a function of the finished lock: it draws from the rows of its part.

Textures and skies of a user's own are few and serve all parts: they are a file of their own too.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.making.publication import Publication
from storage.dataset.layout import DatasetFolder
from storage.dataset.lock_parts import known_lock
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import part_of_object, part_of_shard
from storage.digests import sha256_of_file
from storage.records.objects import (
    OBJECT,
    Failure,
    LockedObject,
    read_objects_lock,
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
        return self.folder.lock_part(f"{self.number:04d}")

    @property
    def index(self) -> Path:
        """The index of that file."""
        if self.number is None:
            return self.folder.staged_index
        return self.folder.staged_locks / f"{self.number:04d}.index"

    @property
    def maps(self) -> Path:
        """File with the rows of textures and skies."""
        return self.folder.objects_lock if self.number is None else self.folder.lock_part("maps")

    def holds(self, uid: str) -> bool:
        """Return whether an object belongs to this part."""
        return self.number is None or part_of_object(uid, self.splits) == self.number

    def has_shard(self, shard_index: int) -> bool:
        """Return whether a shard draws from this part."""
        return self.number is None or part_of_shard(shard_index, self.splits) == self.number

    def take(self, publication: Publication) -> None:
        """Have the files of this part here, where it is frozen already."""
        if self.number is None:
            publication.take_lock()
        else:
            publication.take([self.lock, self.index, self.maps])

    def frozen(self, publication: Publication) -> dict[str, LockedObject] | None:
        """Return what is frozen of this part by uid, or None where nothing is yet."""
        self.take(publication)
        if self.number is None:
            rows = _whole(publication)
        elif self.lock.exists():
            rows = read_objects_lock(self.lock)
        else:  # of a dataset whose .staging was deleted
            rows = [
                row for row in _whole(publication) if row.kind == OBJECT and self.holds(row.uid)
            ]
        return {entry.uid: entry for entry in rows} or None

    def frozen_maps(self, publication: Publication) -> dict[str, LockedObject] | None:
        """Return what is frozen of textures and skies by uid, or None where nothing is yet."""
        self.take(publication)
        if self.number is not None and self.maps.exists():
            rows = read_objects_lock(self.maps)
        else:
            rows = [row for row in _whole(publication) if row.kind != OBJECT]
        return {entry.uid: entry for entry in rows} or None

    def freeze(
        self,
        publication: Publication,
        objects: Sequence[LockedObject],
        maps: Sequence[LockedObject],
        failures: Iterable[Failure],
    ) -> None:
        """Freeze the objects of this part, beside those of others, and the maps with the first.

        Args:
            publication: the dataset.
            objects: rows of this part.
            maps: rows of textures and skies.
            failures: what was rejected on the way.
        """
        if self.number is None:
            publication.lock_objects([*objects, *maps])
            return
        if maps:
            publication.freeze_lock_part(self.maps, maps)
        publication.freeze_lock_part(self.lock, objects, failures)

    def restore(
        self,
        publication: Publication,
        objects: Sequence[LockedObject],
        maps: Sequence[LockedObject],
    ) -> None:
        """Have the files of a frozen part here, after a kill or where `.staging` was deleted."""
        if self.number is not None:
            if maps:
                publication.restore_lock_part(self.maps, maps)
            publication.restore_lock_part(self.lock, objects)

    def is_public(self, publication: Publication, sha256: str) -> bool:
        """Return whether the rows of this part, which have a digest, are those of the dataset."""
        if self.number is None:
            return publication.manifest.objects_lock_sha256 == sha256
        return sha256_of_file(self.lock) == sha256

    def num_frozen(self) -> int:
        """Return how many rows are frozen by now, as far as is known here."""
        return known_lock(self.folder).count(b"\n")


def _whole(publication: Publication) -> list[LockedObject]:
    if not publication.manifest.objects_lock_sha256:
        return []
    return read_objects_lock(publication.folder.objects_lock)


def lock_parts(
    folder: DatasetFolder, splits: SplitSettings, shards: Sequence[int]
) -> list[LockPart]:
    """Return the parts that some shards draw from, those of the first shards first."""
    if splits.object_parts == 1:
        return [LockPart(folder=folder, splits=splits)]
    numbers = dict.fromkeys(part_of_shard(index, splits) for index in shards)
    return [LockPart(folder=folder, splits=splits, number=number) for number in numbers]
