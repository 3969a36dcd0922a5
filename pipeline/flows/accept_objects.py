"""From a source of objects to the frozen list that scenes draw from."""

from dataclasses import dataclass

from pipeline.assets.stage import PreparedAsset, prepare_assets
from pipeline.flows.children import ChildPool
from pipeline.flows.publication import Publication
from pipeline.flows.settings import BuildSettings
from pipeline.isolation import ChildLimits, IsolatedChild, preload
from pipeline.objects.licences import refuse_licences
from pipeline.objects.sources import list_objects
from storage.conventions import SPLITS
from storage.errors import TrilightError
from storage.objects_lock import read_objects_lock
from storage.progress import announce_objects
from storage.records import LockedObject
from storage.splits import require_objects, split_of_object, split_of_shard

_ASSET_LIMITS = ChildLimits(memory_bytes=5 << 30, wall_s=60, calls_per_child=50)
"""Measured on 148 objects and 78 hostile files: a usable mesh takes seconds and far below 1 GiB."""


@dataclass(frozen=True, kw_only=True)
class AcceptedObjects:
    """What scenes may use."""

    objects: tuple[tuple[LockedObject, str], ...]
    """Every locked object with the name of its staged asset file."""
    num_found: int
    """Objects in the source, refused ones included."""


def accept_objects(
    source: str, settings: BuildSettings, publication: Publication, workers: int
) -> AcceptedObjects:
    """List, filter and prepare the objects, and freeze them at the first time.

    Raises:
        TrilightError: the source is unusable, no object is accepted, a split has none, or the
            objects are not those that the dataset was begun with.
    """
    folder = publication.folder
    found = list_objects(source, work_dir=folder.staged_objects)
    allowed, refused = refuse_licences(found, settings.allowed_licences)
    frozen = _frozen(publication)
    if frozen is not None:
        allowed = [record for record in allowed if record.uid in frozen]
    announce_objects(folder, len(allowed))
    preload(["pipeline.assets.prepare"])
    pool = ChildPool(_asset_child, workers)
    try:
        prepared, rejected = prepare_assets(
            allowed, settings.assets, folder, borrow_child=pool.borrow, workers=workers
        )
    finally:
        pool.close()
    publication.add_failures([*refused, *rejected])
    locked = [_locked(asset, settings) for asset in prepared]
    if frozen is None:
        _require_enough(locked, settings, publication, source)
        publication.lock_objects(locked)
    else:
        _require_same_objects(source, frozen, locked)
    names = [asset.file_name for asset in prepared]
    return AcceptedObjects(objects=tuple(zip(locked, names, strict=True)), num_found=len(found))


def _asset_child() -> IsolatedChild:
    return IsolatedChild(limits=_ASSET_LIMITS, setup=_nothing_to_set_up)


def _nothing_to_set_up() -> None:
    """The fork server has imported everything already."""


def _frozen(publication: Publication) -> dict[str, LockedObject] | None:
    if not publication.manifest.objects_lock_sha256:
        return None
    return {entry.uid: entry for entry in read_objects_lock(publication.folder.objects_lock)}


def _locked(asset: PreparedAsset, settings: BuildSettings) -> LockedObject:
    record = asset.record
    return LockedObject(
        uid=record.uid,
        asset_sha256=asset.asset_sha256,
        split=split_of_object(asset.geometry_sha256, settings.splits),
        licence=record.licence,
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
    needed = {split_of_shard(i, settings.splits) for i in range(publication.num_shards)}
    require_objects(
        {split: sum(entry.split == split for entry in locked) for split in SPLITS}, needed
    )


def _require_same_objects(
    source: str, frozen: dict[str, LockedObject], now: list[LockedObject]
) -> None:
    by_uid = {entry.uid: entry for entry in now}
    for uid, entry in frozen.items():
        if by_uid.get(uid) != entry:
            state = "has changed" if uid in by_uid else "is missing or no longer usable"
            raise TrilightError(
                f"objects {source!r}: {uid!r} {state}; expected the objects that the dataset was "
                "begun with (objects.lock.jsonl). Restore it, or choose another --out."
            )
