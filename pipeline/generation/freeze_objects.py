"""Freezes the objects of a dataset: the pool that its scenes draw from, equal for all workers."""

import logging
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from pipeline.assets.stage import PreparedObject
from pipeline.builds.settings import BuildSettings
from pipeline.generation.accept_maps import NO_MAPS, AcceptedMaps
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.object_options import ObjectOptions
from pipeline.generation.scene_origin import ComposedScenes, SceneOrigin
from pipeline.generation.unread_notes import format_unread, write_unread
from pipeline.isolation import is_transient
from storage.conventions import SPLITS
from storage.dataset.splits import require_objects, split_of_object, split_of_shard
from storage.errors import EnvironmentFailure, TrilightError
from storage.records.object_index import IndexedObject, write_object_index
from storage.records.objects import (
    OBJECT,
    Failure,
    LockedObject,
    count_by_reason,
    read_objects_lock,
)
from storage.records.safe_read import open_plain
from storage.remote.safe_url import safe_url

log = logging.getLogger("trilight.objects")


@dataclass(frozen=True, kw_only=True)
class AcceptedObjects:
    """The frozen inputs of a dataset's scenes."""

    num_objects: int
    """Objects that scenes may draw from."""
    num_found: int
    """Objects in the source, refused ones included."""
    origin: SceneOrigin


def freeze_objects(
    options: ObjectOptions,
    prepared: list[PreparedObject],
    rejected: list[Failure],
    num_found: int,
    maps: AcceptedMaps = NO_MAPS,
) -> AcceptedObjects:
    """Freeze the objects in the first run; in later runs require that they are the same.

    Args:
        options: source, licences and settings of the objects.
        prepared: objects that the mesh stage accepted; in later runs the frozen ones among them.
        rejected: rejections by the source and by the mesh stage.
        num_found: number of objects in the source.
        maps: the user's textures and maps, which are frozen with the objects.

    Raises:
        TrilightError: no object is accepted, a split has none, or the objects are not those that
            the dataset was begun with.
        EnvironmentFailure: a frozen object could not be prepared this time.
    """
    writer = options.writer
    settings = options.settings
    display_name = safe_url(options.source)
    frozen = read_frozen_objects(writer)
    transient = [failure for failure in rejected if is_transient(failure.reason)]
    if frozen is not None:
        for failure in transient:
            require_tried(display_name, failure)
    writer.add_failures([*rejected, *maps.failures])
    objects = [_lock_entry(asset, settings) for asset in prepared]
    locked = [*objects, *(entry for entry, _ in maps.rows)]
    if frozen is None:
        _require_enough(objects, settings, writer, display_name)
        _warn_of_transient(display_name, transient)
        _warn_of_drawn_materials(display_name, prepared, writer.folder.logs)
        _warn_of_unread(display_name, prepared, writer.folder.logs)
        writer.lock_objects(locked)
    else:
        require_same(display_name, frozen, locked)
    _write_index(options, locked, prepared, num_found)
    return AcceptedObjects(
        num_objects=len(objects),
        num_found=num_found,
        origin=ComposedScenes(pool=options.pool, maps=maps.rows),
    )


def _write_index(
    options: ObjectOptions,
    locked: list[LockedObject],
    prepared: list[PreparedObject],
    num_found: int,
) -> None:
    """Write the index of the lock, by which later workers load it without opening objects."""
    assets = {asset.record.uid: asset for asset in prepared}
    writer = options.writer
    folder = writer.folder
    objects = list[IndexedObject]()
    offset = 0
    with open_plain(folder.objects_lock) as lines:
        for line, entry in zip(lines, sorted(locked, key=attrgetter("uid")), strict=True):
            if entry.kind == OBJECT:
                asset = assets[entry.uid]
                objects.append(
                    IndexedObject(
                        locked=entry,
                        offset=offset,
                        asset_name=asset.asset_name,
                        least_triangles=asset.least_triangles,
                    )
                )
            offset += len(line)
    write_object_index(
        folder.staged_index,
        objects,
        lock_sha256=writer.manifest.objects_lock_sha256,
        lock_bytes=offset,
        request_digest=options.digest,
        num_found=num_found,
        num_maps=len(locked) - len(objects),
    )
    writer.publish(folder.staged_index)


def read_frozen_objects(writer: DatasetWriter) -> dict[str, LockedObject] | None:
    """Return the frozen objects by uid, or None if nothing is frozen yet."""
    if not writer.manifest.objects_lock_sha256:
        return None
    return {entry.uid: entry for entry in read_objects_lock(writer.folder.objects_lock)}


def _lock_entry(asset: PreparedObject, settings: BuildSettings) -> LockedObject:
    return LockedObject(
        **asset.record.identity,
        asset_sha256=asset.asset_sha256,
        split=split_of_object(asset.geometry_sha256, settings.splits),
    )


def _require_enough(
    locked: list[LockedObject], settings: BuildSettings, writer: DatasetWriter, source: str
) -> None:
    if not locked:
        raise TrilightError(
            f"objects {source!r}: none was accepted; expected at least one usable object with an "
            f"allowed licence. The reasons are in {writer.folder.failures}."
        )
    shards = range(writer.num_shards)
    splits_in_use = {split_of_shard(index, settings.splits) for index in shards}
    require_objects(
        {split: sum(entry.split == split for entry in locked) for split in SPLITS}, splits_in_use
    )


def require_tried(source: str, failure: Failure) -> None:
    """Raise EnvironmentFailure if a frozen object failed for a transient reason."""
    if is_transient(failure.reason):
        raise EnvironmentFailure(
            f"objects {source!r}: {failure.item!r}, which the dataset was begun with, could not be "
            f"prepared this time ({failure.reason}: {failure.message}). Nothing has changed; run "
            "the same command again."
        )


def object_changed_error(source: str, uid: str, state: str) -> TrilightError:
    """Return the error of a frozen object that its source has lost or changed."""
    return TrilightError(
        f"objects {source!r}: {uid!r} {state}; expected the objects that the dataset was begun "
        "with (objects.lock.jsonl). Restore it, or choose another --out."
    )


def _warn_of_transient(source: str, transient: list[Failure]) -> None:
    if transient:
        counts = ", ".join(f"{count} x {why}" for _, why, count in count_by_reason(transient))
        log.warning(
            "objects %r: %d could not be prepared this time (%s), each after several tries, and "
            "the dataset is begun without them; failures.jsonl names them. A dataset begun later "
            "tries them again.",
            source,
            len(transient),
            counts,
        )


def _warn_of_drawn_materials(source: str, prepared: list[PreparedObject], logs: Path) -> None:
    """Log and record the objects that get drawn materials although their own were requested."""
    drawn = {each.record.uid: (each.without_own,) for each in prepared if each.without_own}
    path = write_unread(logs, drawn, "drawn_materials")
    if drawn:
        log.warning(
            "objects %r: %d of %d have no materials of their own at every level and get drawn "
            "ones there. `trilight assets --own-materials` says what was found in each:\n%s",
            source,
            len(drawn),
            len(prepared),
            "\n".join(format_unread(drawn, path)),
        )


def _warn_of_unread(source: str, prepared: list[PreparedObject], logs: Path) -> None:
    """Log and record the parts of the objects' files that no reader supports."""
    unread = {asset.record.uid: asset.unread for asset in prepared if asset.unread}
    path = write_unread(logs, unread)
    if unread:
        log.warning(
            "objects %r: %d of %d have parts that are not read:\n%s",
            source,
            len(unread),
            len(prepared),
            "\n".join(format_unread(unread, path)),
        )


def require_same(source: str, frozen: dict[str, LockedObject], now: list[LockedObject]) -> None:
    """Raise TrilightError if a frozen row is missing or differs now."""
    by_uid = {entry.uid: entry for entry in now}
    for uid, entry in frozen.items():
        if by_uid.get(uid) != entry:
            state = "has changed" if uid in by_uid else "is missing or no longer usable"
            raise object_changed_error(source, uid, state)
