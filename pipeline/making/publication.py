"""The manifest of a dataset in the making: begun, compared, and extended shard by shard."""

import contextlib
import dataclasses
import time
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pipeline.builds.settings import BuildSettings, differences
from pipeline.shards.pack import forget_note, note_shard, noted_shard, rejections_of_shard
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.derived import derivation_of
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, read_manifest, write_manifest
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import planned_scenes, scenes_of_shard, shard_name, shards_for
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import recorded, require_same_extensions
from storage.records.objects import (
    Failure,
    LockedObject,
    encode_objects_lock,
    read_failures,
    write_failures,
    write_objects_lock,
)
from storage.settings.described import from_record

_LOOKS = 7
"""For a shard that a worker says it has packed; network file systems may show it a minute later."""


class Publication:
    """What is public of a dataset, shared by all who make it.

    Every change of the manifest is made in turn, to what is on the disk then, and reaches the disk
    before the call returns. A finished shard is noted beside the staged scenes, and the manifest
    takes such notes up whenever they are a tenth of what it lists: its size times the number of
    shards would otherwise be written in all.
    """

    def __init__(self, folder: DatasetFolder, manifest: Manifest, splits: SplitSettings) -> None:
        self.folder = folder
        self.manifest = manifest
        self._splits = splits
        self._noted: dict[str, ShardEntry] = {}

    def dataset(self) -> Dataset:
        """Return what is public, for whoever reads it."""
        return open_dataset(str(self.folder.root))

    def send_documents(self) -> None:
        """Bring the documents of the folder to where the dataset is: here they are."""

    def send_index(self) -> None:
        """Bring the index of the frozen objects to where the dataset is: here it is."""

    @property
    def num_shards(self) -> int:
        """How many shards the dataset will have."""
        return shards_for(self.manifest.num_scenes, self._splits)

    def lock_objects(self, objects: list[LockedObject]) -> None:
        """Freeze the objects of the dataset."""
        write_objects_lock(self.folder.objects_lock, objects)
        digest = sha256_hex(encode_objects_lock(objects))
        with self._turn():
            self._write(objects_lock_sha256=digest)

    def add_shard(self, shard: ShardEntry) -> None:
        """Note a finished shard; the manifest lists it soon, at the latest after `publish`.

        Raises:
            TrilightError: it is not here, so that its maker works in another folder.
        """
        self._require_here(shard.name)
        note_shard(self.folder, shard)
        self._noted[shard.name] = shard
        if 10 * len(self._noted) >= len(self.manifest.shards):
            self.publish()

    def publish(self) -> None:
        """List every shard that is there, whoever made it, and its rejections."""
        with self._turn():
            listed = {entry.name: entry for entry in self.manifest.shards}
            names = [shard_name(index, self._splits) for index in range(self.num_shards)]
            found = {
                name: noted_shard(self.folder, name)
                for name in names
                if name not in listed and self._is_there(name)
            }
            found |= self._noted
            self._add_failures(
                failure
                for name in found
                for failure in read_failures(rejections_of_shard(self.folder, name))
            )
            entries = sorted((listed | found).values(), key=_number)
            self._write(shards=tuple(entries))
            self._noted.clear()
        for name in found:
            forget_note(self.folder, name)

    def add_failures(self, failures: Iterable[Failure]) -> None:
        """Add rows to `failures.jsonl`; a row that is there already stays single."""
        with self._turn():
            self._add_failures(failures)

    def missing_shards(self) -> list[int]:
        """Return the shards still to make, publishing those that are whole but not yet listed.

        Other makers leave such shards, and so does a kill between a shard's last rename and the
        manifest's.
        """
        listed = {entry.name for entry in self.manifest.shards}
        names = [shard_name(index, self._splits) for index in range(self.num_shards)]
        there = [self._is_there(name) for name in names]
        if any(exists and name not in listed for name, exists in zip(names, there, strict=True)):
            self.publish()
        return [index for index, exists in enumerate(there) if not exists]

    def _is_there(self, name: str) -> bool:
        """Return whether a shard is where the dataset is."""
        return self.folder.shard(name).exists()

    def _has(self, name: str) -> bool:
        """Return whether a shard that somebody has packed can be seen."""
        return self._is_there(name)

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

    def num_shards_finished(self) -> int:
        """Return how many shards are there, as far as this maker knows."""
        return len(self._known())

    def num_scenes_finished(self) -> int:
        """Return for how many scenes the finished shards stand, given-up ones included."""
        return sum(len(scenes_of_shard(_number(entry), self._splits)) for entry in self._known())

    def num_given_up(self) -> int:
        """Return how many scenes of the finished shards could not be made."""
        return self.num_scenes_finished() - sum(entry.num_samples for entry in self._known())

    def _known(self) -> list[ShardEntry]:
        return list(({entry.name: entry for entry in self.manifest.shards} | self._noted).values())

    def refresh(self) -> None:
        """Read what other makers have written.

        Raises:
            TrilightError: another dataset has been begun in the folder since.
        """
        found = read_manifest(self.folder.manifest)
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
        self.manifest = dataclasses.replace(self.manifest, **changes)
        write_manifest(self.folder.manifest, self.manifest)


def _number(entry: ShardEntry) -> int:
    return int(entry.name.removesuffix(".tar").rpartition("-")[2])


def begin(
    folder: DatasetFolder,
    settings: BuildSettings,
    environment: Mapping[str, Any],
    num_scenes: int,
    *,
    accept_environment: bool,
) -> Publication:
    """Begin a dataset, or go on with the one that is there.

    The number of scenes is rounded up to whole shards, and never falls.

    Raises:
        TrilightError: the dataset was begun with other settings, or in another environment and
            `accept_environment` is False; the message names what differs.
    """
    if num_scenes < 1:
        raise TrilightError(f"scenes is {num_scenes}; expected at least 1.")
    whole = planned_scenes(num_scenes, settings.splits)
    with folder.turn("manifest"):
        if folder.manifest.exists():
            manifest = read_manifest(folder.manifest)
            _require_same_dataset(folder, manifest, settings, environment, accept_environment)
            whole = max(whole, manifest.num_scenes)
        else:
            require_free(folder, _names_in(folder))
            manifest = Manifest(
                build=settings.build,
                settings=settings.as_json(),
                environment=environment,
                num_scenes=whole,
                num_views=settings.scenes.num_views,
                objects_lock_sha256="",
                shards=(),
                extensions=recorded("data"),
            )
        manifest = dataclasses.replace(manifest, num_scenes=whole)
        write_manifest(folder.manifest, manifest)
    return Publication(folder, manifest, settings.splits)


def _require_same_dataset(
    folder: DatasetFolder,
    manifest: Manifest,
    settings: BuildSettings,
    environment: Mapping[str, Any],
    accept_environment: bool,
) -> None:
    _require_generated(folder, manifest)
    require_same_extensions(folder.shown, manifest.extensions, recorded("data"))
    begun = from_record(BuildSettings, manifest.settings).as_json()  # fields may come later
    _require_same(folder, "setting", begun, settings.as_json(), "choose another --out")
    if not accept_environment:
        _require_same(
            folder,
            "environment",
            manifest.environment,
            environment,
            "choose another --out, or accept pictures that agree only within their noise "
            "floors with --accept-environment",
        )


def require_free(folder: DatasetFolder, names: Iterable[str]) -> None:
    """Refuse to begin a dataset where something else is.

    Args:
        folder: of the dataset.
        names: of the shards and documents that are where it is to be.

    Raises:
        TrilightError: there are shards, or a document that the dataset's own would replace.
    """
    there = set(names)
    if any(name.endswith(".tar") for name in there):
        raise TrilightError(
            f"{folder.shown}: there are shards but no manifest.json; expected an empty folder or a "
            "dataset. Choose another --out."
        )
    for path in (folder.card, folder.licences):
        if path.name in there:
            raise TrilightError(
                f"{folder.shown}: {path.name} is there, and the dataset's own would replace it; "
                "expected an empty folder or a dataset. Choose another --out."
            )


def _names_in(folder: DatasetFolder) -> Iterator[str]:
    yield from (path.relative_to(folder.root).as_posix() for path in folder.shard_files())
    yield from (path.name for path in (folder.card, folder.licences) if path.exists())


def _require_generated(folder: DatasetFolder, manifest: Manifest) -> None:
    if derivation := derivation_of(manifest.settings):
        raise TrilightError(
            f"{folder.shown}: this dataset was made by `trilight shards {derivation.operation}` "
            "and cannot grow; extend its sources and make it anew, or choose another --out."
        )


def _require_same(
    folder: DatasetFolder,
    what: str,
    before: Mapping[str, Any],
    now: Mapping[str, Any],
    next_step: str,
) -> None:
    differing = list(differences(before, now))
    if differing:
        name, old, new = differing[0]
        more = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
        raise TrilightError(
            f"{folder.shown}: this dataset was begun with another {what}: {name} was {old!r}, now "
            f"{new!r}{more}; {next_step}."
        )
