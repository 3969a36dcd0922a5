"""From a source to frozen objects; where they are frozen already, from the lock and its index."""

import shutil
from collections.abc import Callable, Container
from dataclasses import replace

from pipeline.making.accept_maps import AcceptedMaps, accept_maps
from pipeline.making.asked_objects import AskedObjects
from pipeline.making.freeze_objects import AcceptedObjects, freeze_objects, require_same
from pipeline.making.lock_parts import LockPart
from pipeline.making.object_parts import Proof, cut_objects, prepare_in_parts
from pipeline.objects.sources import FoundObjects
from storage.dataset.progress import announce_objects, count_object
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.object_index import ObjectIndex
from storage.remote.safe_url import safe_url


def share_mesh_work(order: AskedObjects, part: LockPart) -> FoundObjects | None:
    """Prepare the objects of a part that is not frozen yet, with all who make it; in no turn.

    Returns:
        What the source has, for `accept_objects`, where it has been listed.

    Raises:
        TrilightError: as `find_objects` and `prepare_in_parts`.
    """
    publication = order.publication
    with publication.folder.turn("objects"):  # one maker downloads, and the others find it done
        publication.refresh()
        if part.frozen(publication) is not None:
            return None
        found = order.found(part)
        announce_objects(publication.folder, len(found.records))
    _proofs(found, order, part, enough=lambda: publication.has(part.index))
    return found


def accept_objects(
    order: AskedObjects, part: LockPart | None = None, found: FoundObjects | None = None
) -> AcceptedObjects:
    """Turn a source into frozen meshes: of all its objects, or of those that were frozen before.

    Textures and maps of a user's own are frozen with them. Call in the turn `objects`.

    Args:
        order: what is asked for.
        part: what is to be frozen; by default the whole.
        found: what the source has, where that is known.

    Raises:
        TrilightError, EnvironmentFailure: as `find_objects` and `freeze_objects`.
    """
    settings, folder = order.settings, order.publication.folder
    part = part or order.whole
    if trusted := trusted_objects(order, part):
        return trusted
    frozen = part.frozen(order.publication)
    shared, found = found is not None, found or order.found(part)
    maps = _same_maps(accept_maps(order.own, settings, workers=order.workers), order, part)
    if frozen is None:
        prepared, rejected = _proofs(found, order, part, again=not shared)
    else:
        wanted = _beside(frozen, found)
        announce_objects(folder, len(wanted.records))
        proofs, failures = _proofs(wanted, order, part)
        prepared = [one for one in proofs if one.record.uid in frozen]
        rejected = [failure for failure in failures if failure.item in frozen]
    accepted = freeze_objects(order, found, prepared, rejected, maps, part)
    if part.number is None:
        shutil.rmtree(folder.staged_parts, ignore_errors=True)
    return accepted


def _beside(frozen: Container[str], found: FoundObjects) -> FoundObjects:
    """Return the objects that are frozen, and those that were prepared together with them."""
    parts = cut_objects(found.records)
    kept = [part for part in parts if any(record.uid in frozen for record in part)]
    return replace(found, records=tuple(record for part in kept for record in part))


def _same_maps(maps: AcceptedMaps, order: AskedObjects, part: LockPart) -> AcceptedMaps:
    """Return those of the maps that the dataset was begun with, or all where that is now."""
    frozen = part.frozen_maps(order.publication)
    if frozen is None:
        return maps
    kept = tuple(row for row in maps.rows if row[0].uid in frozen)
    require_same(safe_url(order.source), frozen, [entry for entry, _ in kept])
    return replace(maps, rows=kept)


def _proofs(
    found: FoundObjects,
    order: AskedObjects,
    part: LockPart,
    enough: Callable[[], bool] = lambda: False,
    again: bool = True,
) -> Proof:
    return prepare_in_parts(
        [record for record in found.records if part.holds(record.uid)],
        order.settings.mesh_settings,
        part.folder.staged_parts,
        others=order.publication if part.folder.bucket else None,
        workers=order.workers,
        done=lambda count: count_object(part.folder, count),
        enough=enough,
        again=again,
    )


def trusted_objects(order: AskedObjects, part: LockPart | None = None) -> AcceptedObjects | None:
    """Return the frozen objects by their index, without a look at any of them.

    The lock has their digests, by which each is checked where a scene draws it. None where nothing
    is frozen yet, there is no index of this lock, or another source is asked for than before: then
    every object has to be looked at.

    Raises:
        TrilightError: as `accept_maps`.
    """
    part = part or order.whole
    part.take(order.publication)
    try:
        facts = ObjectIndex(part.index).facts
        lock = LockRows(part.lock)
        known = facts.lock_bytes, facts.asked
        if known != (lock.num_bytes, order.digest):
            return None
        if not part.is_public(order.publication, facts.lock_sha256):
            return None
    except TrilightError:
        return None
    found = accept_maps(order.own, order.settings, workers=order.workers)
    kept = LockRows(part.maps) if facts.num_maps and part.maps.exists() else lock
    maps = tuple(row for row in found.rows if kept.find(row[0].uid) == row[0])
    if len(maps) != facts.num_maps:  # the long way says which one has changed
        return None
    return AcceptedObjects(
        num_objects=facts.num_objects,
        num_found=facts.num_found,
        pool=order.pool(part),
        maps=maps,
    )
