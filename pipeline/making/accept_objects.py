"""From a source to frozen objects; where they are frozen already, from the lock and its index."""

import shutil
from collections.abc import Callable
from dataclasses import replace

from pipeline.making.accept_maps import accept_maps
from pipeline.making.asked_objects import AskedObjects
from pipeline.making.freeze_objects import AcceptedObjects, freeze_objects
from pipeline.making.lock_parts import LockPart
from pipeline.making.object_parts import Proof, prepare_in_parts, proved
from pipeline.making.prepare_isolated import prepare_isolated
from pipeline.objects.sources import FoundObjects
from storage.dataset.progress import announce_objects, count_object
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.object_index import ObjectIndex


def share_mesh_work(order: AskedObjects, part: LockPart) -> FoundObjects | None:
    """Prepare the objects of a part that is not frozen yet, with all who make it; in no turn.

    Returns:
        What the source has, for `accept_objects`, where it has been listed.

    Raises:
        TrilightError: as `find_objects` and `prepare_in_parts`.
    """
    folder = order.publication.folder
    with folder.turn("objects"):  # one maker downloads, and the others find it done
        order.publication.refresh()
        if part.frozen(order.publication) is not None:
            return None
        found = order.found()
        announce_objects(folder, len(found.records))
    _proofs(found, order, part, enough=part.index.exists)
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
    shared, found = found is not None, found or order.found()
    maps = accept_maps(order.own, settings, workers=order.workers)
    if frozen is None:
        prepared, rejected = _proofs(found, order, part, again=not shared)
    else:
        wanted = [record for record in found.records if record.uid in frozen]
        announce_objects(folder, len(wanted))
        assets, rejected = prepare_isolated(
            wanted,
            settings.mesh_settings,
            workers=order.workers,
            done=lambda: count_object(folder),
        )
        prepared = [*map(proved, assets)]
        maps = replace(maps, rows=tuple(row for row in maps.rows if row[0].uid in frozen))
    accepted = freeze_objects(order, found, prepared, rejected, maps, part)
    if part.number is None:
        shutil.rmtree(folder.staged_parts, ignore_errors=True)
    return accepted


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
    maps = tuple(row for row in found.rows if lock.find(row[0].uid) == row[0])
    if len(maps) != facts.num_maps:  # the long way says which one has changed
        return None
    return AcceptedObjects(
        num_objects=facts.num_objects,
        num_found=facts.num_found,
        pool=order.pool(part),
        maps=maps,
    )
