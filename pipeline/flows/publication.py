"""The manifest of a dataset in the making: begun, compared, and extended shard by shard."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from pipeline.flows.settings import BuildSettings, differences
from pipeline.shards.pack import rejections_of_shard
from storage.derived import derivation_of
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.failures import read_failures, write_failures
from storage.layout import DatasetFolder
from storage.manifest import Manifest, ShardEntry, index_shard, read_manifest, write_manifest
from storage.objects_lock import encode_objects_lock, write_objects_lock
from storage.records import Failure, LockedObject
from storage.splits import (
    SplitSettings,
    planned_scenes,
    scenes_of_shard,
    shard_name,
    shards_for,
)


class Publication:
    """What is public of a dataset; every change reaches the disk before the call returns."""

    def __init__(self, folder: DatasetFolder, manifest: Manifest, splits: SplitSettings) -> None:
        self.folder = folder
        self.manifest = manifest
        self._splits = splits

    @property
    def num_shards(self) -> int:
        """How many shards the dataset will have."""
        return shards_for(self.manifest.num_scenes, self._splits)

    def lock_objects(self, objects: list[LockedObject]) -> None:
        """Freeze the objects of the dataset."""
        write_objects_lock(self.folder.objects_lock, objects)
        digest = sha256_hex(encode_objects_lock(objects))
        self._publish(objects_lock_sha256=digest)

    def add_shard(self, shard: ShardEntry) -> None:
        """Publish a finished shard and its rejections."""
        self.add_failures(read_failures(rejections_of_shard(self.folder, shard.name)))
        others = [entry for entry in self.manifest.shards if entry.name != shard.name]
        by_index = sorted([*others, shard], key=lambda entry: entry.name.rsplit("-")[-1])
        self._publish(shards=tuple(by_index))

    def add_failures(self, failures: Iterable[Failure]) -> None:
        """Add rows to `failures.jsonl`; a row that is there already stays single."""
        known = read_failures(self.folder.failures)
        write_failures(self.folder.failures, [*known, *failures])

    def missing_shards(self) -> list[int]:
        """Return the shards still to make, publishing those that are whole but not yet listed.

        A run that was killed between a shard's last rename and the manifest's leaves such a shard.
        """
        listed = {entry.name for entry in self.manifest.shards}
        missing = []
        for index in range(self.num_shards):
            name = shard_name(index, self._splits)
            path = self.folder.shard(name)
            if not path.exists():
                missing.append(index)
            elif name not in listed:
                self.add_shard(index_shard(path))
        return missing

    def num_given_up(self) -> int:
        """Return how many scenes of the finished shards could not be made."""
        listed = {entry.name for entry in self.manifest.shards}
        wanted = sum(
            len(scenes_of_shard(index, self._splits))
            for index in range(self.num_shards)
            if shard_name(index, self._splits) in listed
        )
        return wanted - self.manifest.num_samples

    def _publish(self, **changes: Any) -> None:
        self.manifest = dataclasses.replace(self.manifest, **changes)
        write_manifest(self.folder.manifest, self.manifest)


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
    if folder.manifest.exists():
        manifest = read_manifest(folder.manifest)
        _require_generated(folder, manifest)
        _require_same(
            folder, "setting", manifest.settings, settings.as_json(), "choose another --out"
        )
        if not accept_environment:
            _require_same(
                folder,
                "environment",
                manifest.environment,
                environment,
                "choose another --out, or accept pictures that agree only within their noise "
                "floors with --accept-environment",
            )
        whole = max(whole, manifest.num_scenes)
    else:
        _require_free(folder)
        manifest = Manifest(
            build=settings.build,
            settings=settings.as_json(),
            environment=environment,
            num_scenes=whole,
            num_views=settings.scenes.num_views,
            objects_lock_sha256="",
            shards=(),
        )
    manifest = dataclasses.replace(manifest, num_scenes=whole)
    write_manifest(folder.manifest, manifest)
    return Publication(folder, manifest, settings.splits)


def _require_free(folder: DatasetFolder) -> None:
    if folder.shard_files():
        raise TrilightError(
            f"{folder.root}: there are shards but no manifest.json; expected an empty folder or a "
            "dataset. Choose another --out."
        )
    for path in (folder.card, folder.licences):
        if path.exists():
            raise TrilightError(
                f"{folder.root}: {path.name} is there, and the dataset's own would replace it; "
                "expected an empty folder or a dataset. Choose another --out."
            )


def _require_generated(folder: DatasetFolder, manifest: Manifest) -> None:
    if derivation := derivation_of(manifest.settings):
        raise TrilightError(
            f"{folder.root}: this dataset was made by `trilight shards {derivation.operation}` and "
            "cannot grow; extend its sources and make it anew, or choose another --out."
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
            f"{folder.root}: this dataset was begun with another {what}: {name} was {old!r}, now "
            f"{new!r}{more}; {next_step}."
        )
