"""From a source to frozen objects; where they are frozen already, from the lock and its index."""

from dataclasses import replace

from pipeline.builds.settings import BuildSettings
from pipeline.making.accept_maps import NO_FOLDERS, MapFolders, accept_maps
from pipeline.making.freeze_objects import (
    AcceptedObjects,
    asked_digest,
    freeze_objects,
    frozen_objects,
)
from pipeline.making.frozen_pool import FrozenPool
from pipeline.making.prepare_isolated import prepare_isolated
from pipeline.making.publication import Publication
from pipeline.objects.sources import find_objects
from storage.dataset.progress import announce_downloads, announce_objects, count_object
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.object_index import ObjectIndex


def accept_objects(
    source: str,
    licence: str | None,
    settings: BuildSettings,
    publication: Publication,
    workers: int,
    own: MapFolders = NO_FOLDERS,
) -> AcceptedObjects:
    """Turn a source into frozen meshes: of all its objects, or of those that were frozen before.

    Textures and maps of a user's own are frozen with them.

    Raises:
        TrilightError, EnvironmentFailure: as `find_objects` and `freeze_objects`.
    """
    if trusted := trusted_objects(source, licence, settings, publication, workers, own):
        return trusted
    folder, frozen = publication.folder, frozen_objects(publication)
    found = find_objects(
        source,
        work_dir=folder.staged_objects,
        allowed_licences=settings.allowed_licences,
        licence=licence,
        downloaded=lambda done, total: announce_downloads(folder, done, total),
    )
    wanted = [record for record in found.records if frozen is None or record.uid in frozen]
    announce_objects(folder, len(wanted))
    prepared, rejected = prepare_isolated(
        wanted, settings.mesh_settings, workers=workers, done=lambda: count_object(folder)
    )
    maps = accept_maps(own, settings, workers=workers)
    if frozen is not None:
        maps = replace(maps, rows=tuple(row for row in maps.rows if row[0].uid in frozen))
    return freeze_objects(source, licence, found, prepared, rejected, settings, publication, maps)


def trusted_objects(
    source: str,
    licence: str | None,
    settings: BuildSettings,
    publication: Publication,
    workers: int,
    own: MapFolders = NO_FOLDERS,
) -> AcceptedObjects | None:
    """Return the frozen objects by their index, without a look at any of them.

    The lock has their digests, by which each is checked where a scene draws it. None where nothing
    is frozen yet, there is no index of this lock, or another source is asked for than before: then
    every object has to be looked at.

    Raises:
        TrilightError: as `accept_maps`.
    """
    folder = publication.folder
    try:
        facts = ObjectIndex(folder.staged_index).facts
        lock = LockRows(folder.objects_lock)
    except TrilightError:
        return None
    known = facts.lock_sha256, facts.lock_bytes, facts.asked
    frozen = publication.manifest.objects_lock_sha256
    if known != (frozen, lock.num_bytes, asked_digest(source, licence)):
        return None
    found = accept_maps(own, settings, workers=workers)
    maps = tuple(row for row in found.rows if lock.find(row[0].uid) == row[0])
    if len(maps) != facts.num_maps:  # the long way says which one has changed
        return None
    return AcceptedObjects(
        num_objects=facts.num_objects,
        num_found=facts.num_found,
        pool=FrozenPool(
            lock=folder.objects_lock, index=folder.staged_index, source=source, licence=licence
        ),
        maps=maps,
    )
