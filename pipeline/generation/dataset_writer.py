"""`DatasetWriter`: publishes shards and writes the manifest of a dataset, in a folder or a bucket.

A bucket has the same files as a folder, and is written by any number of machines. Manifest, lock
and shards are each created once; the server refuses a second writer, which then reads the existing
file. Each machine has a folder before the bucket, for what is not published yet, and with a copy of
the head of the manifest. A dataset is begun, or resumed with the same settings, by
`begin_or_resume_dataset`; `DatasetWriter.unfinished_shards` says which shards are left.
"""

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import device_of
from pipeline.shards.pack_shards import PLANNED, PublishedShards, unpack_here
from storage.atomic import write_atomically
from storage.dataset.dataset import Dataset, published_manifest
from storage.dataset.layout import DatasetFolder, in_parts, parts_of, place_of_part, shard_names_in
from storage.dataset.manifest import (
    Manifest,
    ShardEntry,
    derivation_of,
    number_of_shard,
    read_head,
    read_manifest,
    write_manifest,
)
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import (
    cut_splits,
    planned_scenes,
    scenes_of_shard,
    shard_name,
    shards_for,
)
from storage.dataset.staging import ShardNote, noted_names, rejections_of_shard
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.records.objects import (
    Failure,
    LockedObject,
    encode_objects_lock,
    read_failures,
    read_objects_lock,
    write_failures,
)
from storage.remote.store import RemoteStore, Store
from storage.settings.described import from_record, settings_record
from storage.settings.overrides import differences

_LISTING = ".staging/listing/"
_LISTED = ".staging/listed/"
"""Folders of a bucket with one file for each number of scenes whose shards some machine lists, and
has listed."""
_PATIENCE_S = 10.0
"""Seconds to wait for the machine that lists the shards, and again for each _NOTES_MEANWHILE."""
_NOTES_MEANWHILE = 5_000
_LONGEST_PAUSE_S = 8.0
_MAX_LOOKS = 7
"""Looks for a shard that a worker has packed; network file systems may show it a minute later."""


class DatasetWriter:
    """Writes the published files of a dataset to its store, together with its other workers.

    Every file is written in the folder first, and published from there; in a folder of this machine
    that is one step. Until all shards are finished the manifest is a head of a few kilobytes, and
    each shard has a note: a worker writes notes on its own shards, and reads only those of the
    requested ones. Every change of the manifest holds its mutex, applies to the file on disk at
    that moment, and reaches the disk before the call returns.
    """

    def __init__(self, shards: PublishedShards, manifest: Manifest, splits: SplitSettings) -> None:
        self.store = shards.store
        """Where the dataset is published."""
        self.folder = shards.folder
        self.manifest = manifest
        """Manifest of the dataset; it lists shards only once the dataset is finished."""
        self.given_up = 0
        """Scenes of this run that could not be made; of all runs once the dataset is finished."""
        self.failures: list[Failure] = []
        """Rejections of this run's scenes, until the manifest lists their shards."""
        self.left_to_others = False
        """True if another machine has just listed the shards, and writes the documents."""
        self._splits = splits
        self._shards = shards
        self._ends: dict[str, range] = {}
        """Last shards of earlier plans of a bucket, by name, with the scenes that they should hold
        now."""

    @property
    def splits(self) -> SplitSettings:
        """Split settings, cut to the planned scenes: the last shard may hold fewer."""
        return cut_splits(self.manifest.num_scenes, self._splits)

    @property
    def num_shards(self) -> int:
        return shards_for(self.manifest.num_scenes, self._splits)

    def dataset(self) -> Dataset:
        return Dataset(self.store, read_manifest(self.folder.manifest))

    def publish(self, *paths: Path) -> None:
        """Publish files of the folder, in this order, replacing existing ones."""
        for path in paths:
            self.store.put(self.folder.name_of(path), path)

    def publish_manifest(self) -> None:
        """Publish the manifest, after the rejections."""
        with self.folder.mutex("manifest"):
            self.publish(self.folder.failures, self.folder.manifest)

    def publish_documents(self) -> None:
        """Publish the documents, the card last, after the manifest, which holds their digests."""
        folder = self.folder
        self.publish_manifest()
        self.publish(
            *(folder.attribution, folder.licences, folder.contact_sheet, folder.report),
            *sorted(path for path in folder.report_pages.rglob("*") if path.is_file()),
            *(folder.croissant, folder.card),
        )

    def is_published(self, path: Path) -> bool:
        return path.exists() or self.store.get(self.folder.name_of(path), 1) is not None

    @contextlib.contextmanager
    def claim(self, path: Path) -> Iterator[bool]:
        """Hold the claim on a file that one worker makes; yield True if this worker holds it.

        Another worker may have made the file in the meantime: then it is here. The holder publishes
        it. Only one process of a machine holds a claim at a time.
        """
        self._shards.fetch(path)
        if path.exists():
            yield True
            return
        with self.store.hold_lock(self.folder.name_of(path)) as ours:
            if ours:
                self._shards.fetch(path)  # its last holder may have published it
            yield ours

    def frozen_objects(self) -> dict[str, LockedObject] | None:
        """Return the frozen objects by uid, or None if nothing is frozen yet."""
        if not self.manifest.objects_lock_sha256:
            return None
        return {entry.uid: entry for entry in read_objects_lock(self.folder.objects_lock)}

    def lock_objects(self, objects: list[LockedObject]) -> None:
        """Freeze the objects of the dataset: write their lock file and its digest.

        The rejections that led to them are published before; those of other workers stay.

        Raises:
            TrilightError: another worker has frozen other objects in the meantime.
        """
        lock = encode_objects_lock(objects)
        name = self.folder.objects_lock.name
        theirs = self.store.get(name)
        with self.hold_lock("manifest"):
            if theirs in (None, lock):
                self._shards.merge_failures()
                self.publish(self.folder.failures)
            if theirs is None and not self.store.create_if_absent(name, lock):
                theirs = self.store.get(name)
            if theirs not in (None, lock):
                raise TrilightError(
                    f"{self.folder.display_name}: another worker has frozen other objects in the "
                    "meantime; expected the same --objects everywhere. Give that, or choose "
                    "another --out."
                )
            write_atomically(self.folder.objects_lock, lock)  # before a bucket, here too
            self._write(objects_lock_sha256=sha256_hex(lock))
        self.publish_manifest()

    def fetch_lock(self) -> None:
        """Take over the lock and its index if another worker has frozen the objects."""
        if self.manifest.objects_lock_sha256:
            return
        head = self._shards.read_published_head()
        if head and head.objects_lock_sha256:
            self._shards.fetch_lock(head.objects_lock_sha256)
            with self.hold_lock("manifest"):
                self._write(objects_lock_sha256=head.objects_lock_sha256)

    def add_shard(self, shard: ShardEntry) -> None:
        """Publish and note a finished shard.

        Raises:
            TrilightError: it is not here, so that its worker uses another folder.
        """
        number = number_of_shard(shard)
        own_shard = range(number, number + 1)
        for pause_s in (*(2**look for look in range(_MAX_LOOKS - 1)), 0):
            if self.folder.has_shard(shard.name) or shard.name in self._finished_shards(own_shard):
                break
            time.sleep(pause_s)
        else:
            raise TrilightError(
                f"{self.folder.display_name}: a worker has packed {shard.name}, and it is not "
                "here: the worker's folder is not this one. Expected workers that see the same "
                "--out at the same place (for a bucket, the same TRILIGHT_CACHE); share it, and "
                "run this command again."
            )
        failures = read_failures(rejections_of_shard(self.folder, shard.name))
        note = self._shards.publish(ShardNote(shard=shard, failures=tuple(failures)))
        if note is None:
            return
        scenes = scenes_of_shard(number, self.splits)
        self.failures += note.failures
        self.given_up += len(scenes) - note.shard.num_samples

    def unfinished_shards(self, requested: range | None = None) -> list[int]:
        """Return the unfinished or growing shards among the requested ones; by default of all.

        To resume is to skip shards already finished. The cost depends on the number of requested
        shards alone.
        """
        self._shards.publish_all()
        self.refresh_plan()
        every = range(self.num_shards)
        selected = every if requested is None else every[requested.start : requested.stop]
        return self.missing_shards(selected)

    def missing_shards(self, shards: range) -> list[int]:
        """Return the unfinished or growing ones of some shards of the plan as it is known."""
        finished = self._finished_shards(shards)
        return [index for index in shards if shard_name(index, self._splits) not in finished]

    def _finished_shards(self, shards: range) -> set[str]:
        """Return the names of finished shards: at least all finished ones of a range."""
        published = {
            name
            for part in parts_of(shards)
            for name in self._shards.names_in_part(part, self._ends)
        }
        return published.difference(self.manifest.growing if self.store.is_here else ())

    def num_finished_shards(self) -> int:
        """Return the number of finished shards, as far as this machine knows."""
        folder = self.folder
        if not self.store.is_here:
            return sum(1 for _ in shard_names_in(folder.staged_sent))
        return sum(name not in self.manifest.growing for name in shard_names_in(folder.root))

    def _is_complete(self) -> bool:
        """Return True if every shard is finished; stops at the first part that is not."""
        parts = list(in_parts(range(self.num_shards)))
        if any(len(self._finished_shards(part)) < len(part) for part in parts):  # names cost more
            return False
        return not any(map(self.missing_shards, parts))

    def finish(self) -> Manifest | None:
        """List all shards in the manifest if all are finished, and return it; else None.

        Raises:
            TrilightError: a shard is damaged, or the store cannot be written.
        """
        has_new_plan = True
        while has_new_plan:  # another run may plan and list more before our manifest is published
            self.refresh_plan()
            if not self._is_complete():
                return None
            self._wait_for_lister()
            with self.hold_lock("manifest"):
                if not self._is_complete():  # another run has planned more
                    return None
                listed = self._list_shards()
            if not (self.store.is_here or self.left_to_others):
                self.publish_manifest()
                self.store.put(f"{_LISTED}{listed.num_scenes:012d}", b"\n")
            self.manifest = listed
            has_new_plan = self.refresh_plan()
        self.failures = []
        self.manifest = listed
        self.given_up = listed.num_scenes - listed.num_samples
        return listed

    def _wait_for_lister(self) -> None:
        """Wait while another machine lists the shards: listing costs a request for each shard.

        Machines with tasks of one size end together, and all of them find all shards finished. If
        the listing machine dies, the wait times out, and another machine lists them. In a folder
        the mutex of the manifest does this.
        """
        planned = f"{self.manifest.num_scenes:012d}"
        waited_s = 0.0
        pause_s = 0.5
        self.left_to_others = False
        if self.store.is_here or self.store.create_if_absent(_LISTING + planned, b"\n"):
            return
        patience_s = _PATIENCE_S * (1 + self.num_shards / _NOTES_MEANWHILE)
        listed = self.store.get(_LISTED + planned, 1) is not None
        while waited_s < patience_s and not listed:
            time.sleep(pause_s)
            waited_s = waited_s + pause_s
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
            listed = self.store.get(_LISTED + planned, 1) is not None
            self.left_to_others = listed

    def _list_shards(self) -> Manifest:
        """List all shards in the manifest of the folder, and clear the notes away."""
        folder = self.folder
        if not self.store.is_here:  # what the bucket's manifest lists is no news
            self._shards.merge_failures()
            theirs = published_manifest(self.store)
            if self.left_to_others:
                self._shards.fetch_lock(theirs.objects_lock_sha256)
            else:
                theirs = dataclasses.replace(self.manifest, shards=theirs.shards)
            write_manifest(folder.manifest, theirs)
        listed = read_manifest(folder.manifest)
        shards = {entry.name: entry for entry in listed.shards}
        noted = set(noted_names(folder))  # newer than the list
        every = (shard_name(index, self._splits) for index in range(self.num_shards))
        notes = self._shards.notes([name for name in every if name in noted or name not in shards])
        if notes or listed.growing:
            shards |= {note.shard.name: note.shard for note in notes}
            self._add_failures(failure for note in notes for failure in note.failures)
            sorted_shards = tuple(sorted(shards.values(), key=number_of_shard))
            listed = dataclasses.replace(listed, shards=sorted_shards, growing=(), documents={})
            write_manifest(folder.manifest, listed)
        for staged in (folder.staged_entries, folder.staged_failures):
            shutil.rmtree(staged, ignore_errors=True)
        folder.staged_given_up.unlink(missing_ok=True)
        return listed

    def _extend(self, num_scenes: int) -> None:
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

    def refresh_plan(self, requested: int = 0) -> bool:
        """Plan as many scenes as other workers, or as requested; return True if they are more."""
        before = self.manifest.num_scenes
        names = (name.removeprefix(PLANNED) for name in self.store.list(PLANNED))
        plans = {int(text) for text in names if text.isdecimal()}
        self.refresh()
        if (most := max(requested, *plans, 0)) > self.manifest.num_scenes:
            with self.hold_lock("manifest"):
                if most > self.manifest.num_scenes:  # else another worker was faster
                    self._extend(most)
        splits = self.splits
        each = self._splits.scenes_per_shard
        last = () if splits.listed_shards else {plan // each for plan in plans if plan % each}
        self._ends = {shard_name(at, splits): scenes_of_shard(at, splits) for at in last}
        return self.manifest.num_scenes > before

    def add_failures(self, failures: Iterable[Failure]) -> None:
        """Add rows to `failures.jsonl`, without duplicates."""
        with self.hold_lock("manifest"):
            self._add_failures(failures)

    def refresh(self) -> None:
        """Read the head of the manifest again, as other workers may have changed it.

        Raises:
            TrilightError: another dataset has been begun in the folder since.
        """
        head = read_head(self.folder.manifest)
        if head.settings != self.manifest.settings:
            raise TrilightError(
                f"{self.folder.display_name}: another dataset has been begun here in the meantime; "
                "choose another --out."
            )
        self.manifest = head

    @contextlib.contextmanager
    def hold_lock(self, what: str) -> Iterator[None]:
        """Hold the lock of a step that one worker does at a time, with the manifest as it is then.

        Raises:
            TrilightError: as `refresh`.
        """
        with self.folder.mutex(what):
            self.refresh()
            yield

    def _add_failures(self, failures: Iterable[Failure]) -> None:
        known = read_failures(self.folder.failures)
        write_failures(self.folder.failures, [*known, *failures])

    def _write(self, **changes: Any) -> None:
        manifest = read_manifest(self.folder.manifest)  # a finished set that grows has shards
        write_manifest(self.folder.manifest, dataclasses.replace(manifest, **changes))
        self.manifest = dataclasses.replace(self.manifest, **changes)


def require_its_extensions(folder: DatasetFolder) -> None:
    """Refuse other extensions than a dataset has, before settings name what those add.

    A dataset without frozen objects may begin again, and what a bucket holds is known only later.

    Raises:
        TrilightError: they differ, or the manifest cannot be read.
    """
    if not folder.bucket and folder.manifest.exists():
        manifest = read_head(folder.manifest)
        if manifest.objects_lock_sha256:
            _require_extendable(folder, manifest)


def _require_extendable(folder: DatasetFolder, manifest: Manifest) -> None:
    if derivation := derivation_of(manifest.settings):
        raise TrilightError(
            f"{folder.display_name}: this dataset was made by `trilight shards "
            f"{derivation.operation}` and cannot grow; extend its sources and make it again, or "
            "choose another --out."
        )
    require_same_extensions(folder.display_name, manifest.extensions, extension_digests("data"))


def begin_or_resume_dataset(
    shards: PublishedShards,
    settings: DatasetSettings,
    environment: Mapping[str, Any],
    num_scenes: int,
    *,
    accept_environment: bool = False,
) -> DatasetWriter:
    """Begin a dataset in a folder or a bucket, or resume the one that is there.

    The number of scenes never falls. Call while holding the dataset's lock.

    Raises:
        TrilightError: the dataset was begun with other settings, or in another environment and
            `accept_environment` is False, and the message names what differs; the bucket cannot be
            listed, read or written, or its server would let two workers create the same file.
    """
    if num_scenes < 1:
        raise TrilightError(f"scenes is {num_scenes}; expected at least 1.")
    num_planned = planned_scenes(num_scenes, settings.splits)
    stated = settings_record(settings)
    folder = shards.folder
    store = shards.store
    with folder.mutex("manifest"):
        if is_new := store.get(folder.manifest.name, 1) is None:
            _require_free(folder, store)
            if isinstance(store, RemoteStore):
                store.require_create()
        if not folder.manifest.exists():
            manifest = Manifest(
                build=settings.build,
                settings=stated,
                environment=environment,
                num_scenes=num_planned,
                num_views=settings.scenes.num_views,
                objects_lock_sha256="",
                shards=(),
                extensions=extension_digests("data"),
            )
            write_manifest(folder.manifest, manifest)
        if is_new and not store.create_if_absent(folder.manifest.name, folder.manifest):
            shards.adopt()  # another machine was first
        manifest = read_head(folder.manifest)
    _require_same_dataset(folder, manifest, stated, environment, accept_environment)
    if not store.is_here:  # in a folder the manifest says so
        store.put(f"{PLANNED}{max(num_planned, manifest.num_scenes):012d}", b"\n")
    writer = DatasetWriter(shards, manifest, settings.splits)
    writer.refresh_plan(num_planned)
    return writer


def _require_same_dataset(
    folder: DatasetFolder,
    manifest: Manifest,
    settings: Mapping[str, Any],
    environment: Mapping[str, Any],
    accept_environment: bool,
) -> None:
    _require_extendable(folder, manifest)
    stored = settings_record(from_record(DatasetSettings, manifest.settings))  # fields came later
    differing = list(differences(stored, settings))
    what = "setting"
    next_step = "choose another --out"
    if not (differing or accept_environment):
        before = device_of(manifest.environment)
        now = device_of(environment)
        if before != now:
            raise TrilightError(
                f"{folder.display_name}: this dataset was begun on a {before.upper()} and would "
                f"go on with a {now.upper()}; choose --device {before} or another --out, or accept "
                "pictures that agree only within their stated errors with --accept-environment."
            )
        differing = list(differences(manifest.environment, environment))
        what = "environment"
        next_step += (
            ", or accept pictures that agree only within their noise floors with "
            "--accept-environment"
        )
    if differing:
        name, old, new = differing[0]
        more = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
        raise TrilightError(
            f"{folder.display_name}: this dataset was begun with another {what}: {name} was "
            f"{old!r}, now {new!r}{more}; {next_step}."
        )


def _require_free(folder: DatasetFolder, store: Store) -> None:
    """Raise if there are shards, or a document that the dataset's own would replace."""
    existing = store.list() | store.list(place_of_part(1))
    if any(name.endswith(".tar") for name in existing):
        raise TrilightError(
            f"{folder.display_name}: there are shards but no manifest.json; expected an empty "
            "folder or a dataset. Choose another --out."
        )
    for path in (folder.card, folder.licences):
        if path.name in existing:
            raise TrilightError(
                f"{folder.display_name}: {path.name} is there, and the dataset's own would replace "
                "it; expected an empty folder or a dataset. Choose another --out."
            )
