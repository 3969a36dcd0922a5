"""From a source to frozen objects; where they are frozen already, from the lock and its index."""

import shutil
from collections.abc import Callable
from dataclasses import replace

from pipeline.builds.settings import BuildSettings
from pipeline.making.accept_maps import NO_FOLDERS, MapFolders, accept_maps
from pipeline.making.freeze_objects import (
    AcceptedObjects,
    asked_digest,
    freeze_objects,
)
from pipeline.making.frozen_pool import FrozenPool
from pipeline.making.lock_parts import LockPart
from pipeline.making.object_parts import Proof, prepare_in_parts, proved
from pipeline.making.prepare_isolated import prepare_isolated
from pipeline.making.publication import Publication
from pipeline.objects.sources import FoundObjects, find_objects
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import announce_downloads, announce_objects, count_object
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.object_index import ObjectIndex


def share_mesh_work(
    source: str,
    licence: str | None,
    settings: BuildSettings,
    publication: Publication,
    workers: int,
    part: LockPart,
    found: FoundObjects | None = None,
) -> FoundObjects | None:
    """Prepare the objects of a part that is not frozen yet, with all who make it; in no turn.

    Returns:
        What the source has, for `accept_objects`, where it has been listed.

    Raises:
        TrilightError: as `find_objects` and `prepare_in_parts`.
    """
    folder = publication.folder
    with folder.turn("objects"):  # one maker downloads, and the others find it done
        publication.refresh()
        if part.frozen(publication) is not None:
            return found
        found = found or _found(source, licence, settings, folder)
        announce_objects(folder, len(found.records))
    _proofs(found, settings, part, workers, enough=part.index.exists)
    return found


def accept_objects(
    source: str,
    licence: str | None,
    settings: BuildSettings,
    publication: Publication,
    workers: int,
    own: MapFolders = NO_FOLDERS,
    part: LockPart | None = None,
    found: FoundObjects | None = None,
) -> AcceptedObjects:
    """Turn a source into frozen meshes: of all its objects, or of those that were frozen before.

    Textures and maps of a user's own are frozen with them. Call in the turn `objects`.

    Args:
        source: as `find_objects` takes it.
        licence: of files without a statement, as the user states it.
        settings: the build.
        publication: the dataset.
        workers: objects at a time.
        own: folders of textures and maps.
        part: what is to be frozen; by default the whole.
        found: what the source has, where that is known.

    Raises:
        TrilightError, EnvironmentFailure: as `find_objects` and `freeze_objects`.
    """
    part = part or LockPart(folder=publication.folder, splits=settings.splits)
    if trusted := trusted_objects(source, licence, settings, publication, workers, own, part):
        return trusted
    folder, frozen = publication.folder, part.frozen(publication)
    shared, found = found is not None, found or _found(source, licence, settings, folder)
    maps = accept_maps(own, settings, workers=workers)
    if frozen is None:
        prepared, rejected = _proofs(found, settings, part, workers, again=not shared)
    else:
        wanted = [record for record in found.records if record.uid in frozen]
        announce_objects(folder, len(wanted))
        assets, rejected = prepare_isolated(
            wanted, settings.mesh_settings, workers=workers, done=lambda: count_object(folder)
        )
        prepared = [*map(proved, assets)]
        maps = replace(maps, rows=tuple(row for row in maps.rows if row[0].uid in frozen))
    accepted = freeze_objects(
        source, licence, found, prepared, rejected, settings, publication, maps, part
    )
    if part.number is None:
        shutil.rmtree(folder.staged_parts, ignore_errors=True)
    return accepted


def _found(
    source: str, licence: str | None, settings: BuildSettings, folder: DatasetFolder
) -> FoundObjects:
    return find_objects(
        source,
        work_dir=folder.staged_objects,
        allowed_licences=settings.allowed_licences,
        licence=licence,
        downloaded=lambda done, total: announce_downloads(folder, done, total),
    )


def _proofs(
    found: FoundObjects,
    settings: BuildSettings,
    part: LockPart,
    workers: int,
    enough: Callable[[], bool] = lambda: False,
    again: bool = True,
) -> Proof:
    return prepare_in_parts(
        [record for record in found.records if part.holds(record.uid)],
        settings.mesh_settings,
        part.folder.staged_parts,
        workers=workers,
        done=lambda count: count_object(part.folder, count),
        enough=enough,
        again=again,
    )


def trusted_objects(
    source: str,
    licence: str | None,
    settings: BuildSettings,
    publication: Publication,
    workers: int,
    own: MapFolders = NO_FOLDERS,
    part: LockPart | None = None,
) -> AcceptedObjects | None:
    """Return the frozen objects by their index, without a look at any of them.

    The lock has their digests, by which each is checked where a scene draws it. None where nothing
    is frozen yet, there is no index of this lock, or another source is asked for than before: then
    every object has to be looked at.

    Raises:
        TrilightError: as `accept_maps`.
    """
    part = part or LockPart(folder=publication.folder, splits=settings.splits)
    try:
        facts = ObjectIndex(part.index).facts
        lock = LockRows(part.lock)
        known = facts.lock_bytes, facts.asked
        if known != (lock.num_bytes, asked_digest(source, licence)):
            return None
        if not part.is_public(publication, facts.lock_sha256):
            return None
    except TrilightError:
        return None
    found = accept_maps(own, settings, workers=workers)
    maps = tuple(row for row in found.rows if lock.find(row[0].uid) == row[0])
    if len(maps) != facts.num_maps:  # the long way says which one has changed
        return None
    return AcceptedObjects(
        num_objects=facts.num_objects,
        num_found=facts.num_found,
        pool=FrozenPool(lock=part.lock, index=part.index, source=source, licence=licence),
        maps=maps,
    )
