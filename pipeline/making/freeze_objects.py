"""The objects of a dataset, frozen: what its scenes draw from, the same for all its makers."""

import logging
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from pipeline.builds.settings import BuildSettings
from pipeline.exchange.scene_files import SceneFiles
from pipeline.isolation import is_passing
from pipeline.making.accept_maps import NO_MAPS, AcceptedMaps
from pipeline.making.asked_objects import AskedObjects
from pipeline.making.frozen_pool import FrozenPool
from pipeline.making.object_batches import PreparedObject
from pipeline.making.publication import Publication
from pipeline.making.revisited_scenes import RevisitedScenes
from pipeline.making.unread import format_unread, write_unread
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
    """What scenes may use."""

    num_objects: int
    """Objects that scenes may draw from."""
    num_found: int
    """Objects in the source, refused ones included."""
    pool: FrozenPool | None = None
    """Where scenes are composed: the frozen objects."""
    maps: tuple[tuple[LockedObject, Path], ...] = ()
    """A user's own textures and skies with their prepared files."""
    files: SceneFiles | None = None
    """Where scenes come from files: those, and the objects are the files themselves."""
    revisited: RevisitedScenes | None = None
    """Where scenes are those of a finished dataset: that, whose objects these are."""


def freeze_objects(
    order: AskedObjects,
    prepared: list[PreparedObject],
    rejected: list[Failure],
    num_found: int,
    maps: AcceptedMaps = NO_MAPS,
) -> AcceptedObjects:
    """Freeze the objects at the first time, and later require that they are the same.

    Args:
        order: what is asked for.
        prepared: objects that the mesh stage accepted, or later those of them that are frozen.
        rejected: refusals of the source, and of the mesh stage.
        num_found: number of objects in the source.
        maps: textures and maps of the user's own, which are frozen with the objects.

    Raises:
        TrilightError: no object is accepted, a split has none, or the objects are not those that
            the dataset was begun with.
        EnvironmentFailure: one of those could not be prepared this time.
    """
    publication, settings = order.publication, order.settings
    shown, frozen = safe_url(order.source), frozen_objects(publication)
    passing = [failure for failure in rejected if is_passing(failure.reason)]
    if frozen is not None:
        for failure in passing:
            require_tried(shown, failure)
    publication.add_failures([*rejected, *maps.failures])
    objects = [_locked(asset, settings) for asset in prepared]
    locked = [*objects, *(entry for entry, _ in maps.rows)]
    if frozen is None:
        _require_enough(objects, settings, publication, shown)
        _warn_of(shown, passing)
        _tell_of_materials(shown, prepared, publication.folder.logs)
        _tell_of_unread(shown, prepared, publication.folder.logs)
        publication.lock_objects(locked)
    else:
        require_same(shown, frozen, locked)
    _index(order, locked, prepared, num_found)
    return AcceptedObjects(
        num_objects=len(objects),
        num_found=num_found,
        pool=order.pool,
        maps=maps.rows,
    )


def _index(
    order: AskedObjects,
    locked: list[LockedObject],
    prepared: list[PreparedObject],
    num_found: int,
) -> None:
    """Write the index of the lock, by which later makers trust it."""
    assets, publication = {asset.record.uid: asset for asset in prepared}, order.publication
    folder, objects, offset = publication.folder, list[IndexedObject](), 0
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
        lock_sha256=publication.manifest.objects_lock_sha256,
        lock_bytes=offset,
        asked=order.digest,
        num_found=num_found,
        num_maps=len(locked) - len(objects),
    )
    publication.send(folder.staged_index)


def frozen_objects(publication: Publication) -> dict[str, LockedObject] | None:
    """Return what the dataset was begun with by uid, or None where nothing is frozen yet."""
    if not publication.manifest.objects_lock_sha256:
        return None
    return {entry.uid: entry for entry in read_objects_lock(publication.folder.objects_lock)}


def _locked(asset: PreparedObject, settings: BuildSettings) -> LockedObject:
    record = asset.record
    return LockedObject(
        uid=record.uid,
        asset_sha256=asset.asset_sha256,
        split=split_of_object(asset.geometry_sha256, settings.splits),
        licence=record.licence,
        licence_source=record.licence_source,
        title=record.title,
        attribution=record.attribution,
        source_url=record.source_url,
    )


def _require_enough(
    locked: list[LockedObject], settings: BuildSettings, publication: Publication, source: str
) -> None:
    if not locked:
        raise TrilightError(
            f"objects {source!r}: none was accepted; expected at least one usable object with an "
            f"allowed licence. The reasons are in {publication.folder.failures}."
        )
    shards = range(publication.num_shards)
    needed = {split_of_shard(index, settings.splits) for index in shards}
    require_objects(
        {split: sum(entry.split == split for entry in locked) for split in SPLITS}, needed
    )


def require_tried(source: str, failure: Failure) -> None:
    """Refuse to judge an object of the dataset where the environment has kept it from us."""
    if is_passing(failure.reason):
        raise EnvironmentFailure(
            f"objects {source!r}: {failure.item!r}, which the dataset was begun with, could not be "
            f"prepared this time ({failure.reason}: {failure.message}). Nothing has changed; run "
            "the same command again."
        )


def changed(source: str, uid: str, state: str) -> TrilightError:
    """Return the error of a frozen object that its source has not got any more as it was."""
    return TrilightError(
        f"objects {source!r}: {uid!r} {state}; expected the objects that the dataset was begun "
        "with (objects.lock.jsonl). Restore it, or choose another --out."
    )


def _warn_of(source: str, passing: list[Failure]) -> None:
    if passing:
        counts = ", ".join(f"{count} x {why}" for _, why, count in count_by_reason(passing))
        log.warning(
            "objects %r: %d could not be prepared this time (%s), each after several tries, and "
            "the dataset is begun without them; failures.jsonl names them. A dataset begun later "
            "tries them again.",
            source,
            len(passing),
            counts,
        )


def _tell_of_materials(source: str, prepared: list[PreparedObject], logs: Path) -> None:
    """Say which objects get drawn materials although their own were asked for, and write it."""
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


def _tell_of_unread(source: str, prepared: list[PreparedObject], logs: Path) -> None:
    """Say what no code has read of the objects' files, and write it down."""
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
    """Raise TrilightError where a frozen row is not among those of now."""
    by_uid = {entry.uid: entry for entry in now}
    for uid, entry in frozen.items():
        if by_uid.get(uid) != entry:
            state = "has changed" if uid in by_uid else "is missing or no longer usable"
            raise changed(source, uid, state)
