"""From a source to frozen objects; where they are frozen already, from the lock and its index."""

import shutil
import threading
from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from operator import attrgetter

from pipeline.making.accept_maps import AcceptedMaps, accept_maps
from pipeline.making.asked_objects import AskedObjects
from pipeline.making.freeze_objects import (
    AcceptedObjects,
    freeze_objects,
    frozen_objects,
    require_same,
)
from pipeline.making.object_batches import (
    ObjectWork,
    PrepareResult,
    cut_objects,
    prepare_in_batches,
)
from pipeline.objects.listing import Fetched
from pipeline.objects.sources import ListedObjects
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import announce_downloads, announce_objects, count_object
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.object_index import ObjectIndex
from storage.records.objects import OBJECT, LockedObject, ObjectRecord
from storage.remote.safe_url import safe_url


def share_mesh_work(order: AskedObjects) -> ListedObjects | None:
    """Prepare objects that are not frozen yet, with all other workers; outside any mutex.

    Returns:
        What the source has, for `accept_objects`, where it has been listed.

    Raises:
        TrilightError: as `list_objects` and `prepare_in_batches`.
    """
    publication = order.publication
    folder = publication.folder
    with folder.turn("objects"):  # one worker writes built-in objects, and the others find them
        publication.refresh()
        publication.take_lock()
        if frozen_objects(publication) is not None:
            return None
        listed = order.listed()
        announce_objects(folder, len(listed.allowed))
    _prepare(listed, listed.allowed, order, enough=lambda: publication.has(folder.staged_index))
    return listed


def accept_objects(order: AskedObjects, listed: ListedObjects | None = None) -> AcceptedObjects:
    """Turn a source into frozen meshes: of all its objects, or of those that were frozen before.

    Textures and maps of a user's own are frozen with them. Call in the turn `objects`.

    Args:
        order: what is asked for.
        listed: what the source has, where that is known.

    Raises:
        TrilightError, EnvironmentFailure: as `list_objects` and `freeze_objects`.
    """
    settings, folder = order.settings, order.publication.folder
    if trusted := trusted_objects(order):
        return trusted
    frozen = frozen_objects(order.publication)
    shared, listed = listed is not None, listed or order.listed()
    maps = _same_maps(accept_maps(order.own, settings, workers=order.workers), order, frozen)
    wanted = listed.allowed
    if frozen is not None:
        wanted = _batches_of(frozen, wanted)
        announce_objects(folder, len(wanted))
    prepared, rejected = _prepare(listed, wanted, order, again=not shared)
    lost = [failure for failure in rejected if failure.stage == "objects"]
    listed.require_some(len(wanted) - len(lost), [*listed.refused, *lost])
    if frozen is not None:
        prepared = [one for one in prepared if one.record.uid in frozen]
        rejected = [failure for failure in rejected if failure.item in frozen]
    accepted = freeze_objects(order, prepared, [*listed.refused, *rejected], listed.num_found, maps)
    shutil.rmtree(folder.staged_batches, ignore_errors=True)
    return accepted


def _same_maps(
    maps: AcceptedMaps, order: AskedObjects, frozen: dict[str, LockedObject] | None
) -> AcceptedMaps:
    """Return those of the maps that the dataset was begun with, or all where that is now."""
    if frozen is None:
        return maps
    kept = tuple(row for row in maps.rows if row[0].uid in frozen)
    of_maps = {uid: entry for uid, entry in frozen.items() if entry.kind != OBJECT}
    require_same(safe_url(order.source), of_maps, [entry for entry, _ in kept])
    return replace(maps, rows=kept)


def _batches_of(frozen: Container[str], records: list[ObjectRecord]) -> list[ObjectRecord]:
    """Return those that share a batch with a frozen object: the batch may be prepared already."""
    batches = cut_objects(sorted(records, key=attrgetter("uid")))
    return [one for batch in batches if any(r.uid in frozen for r in batch) for one in batch]


def _prepare(
    listed: ListedObjects,
    records: Sequence[ObjectRecord],
    order: AskedObjects,
    enough: Callable[[], bool] = lambda: False,
    again: bool = True,
) -> PrepareResult:
    folder = order.publication.folder
    downloads = _Downloads(listed, folder, len(records))
    work = ObjectWork(
        settings=order.settings.mesh_settings,
        publication=order.publication,
        fetch=None if listed.listing.is_here else downloads.fetch,
    )
    return prepare_in_batches(
        sorted(records, key=attrgetter("uid")),
        work,
        workers=order.workers,
        done=lambda count: count_object(folder, count),
        enough=enough,
        again=again,
    )


class _Downloads:
    """The downloads of this worker's batches, announced together."""

    def __init__(self, listed: ListedObjects, folder: DatasetFolder, total: int) -> None:
        self._listed, self._folder, self._total = listed, folder, total
        self._mutex, self._done = threading.Lock(), 0

    def fetch(self, records: list[ObjectRecord]) -> Fetched:
        return self._listed.fetch(records, self._announce)

    def _announce(self, done_of_batch: int, batch: int) -> None:
        with self._mutex:
            self._done += done_of_batch > 0
            announce_downloads(self._folder, self._done, self._total)


def trusted_objects(order: AskedObjects) -> AcceptedObjects | None:
    """Return the frozen objects by their index, without a look at any of them.

    The lock has their digests, by which each is checked where a scene draws it. None where nothing
    is frozen yet, there is no index of this lock, or another source is asked for than before: then
    every object has to be looked at.

    Raises:
        TrilightError: as `accept_maps`.
    """
    publication = order.publication
    folder = publication.folder
    publication.take_lock()
    try:
        facts = ObjectIndex(folder.staged_index).facts
        lock = LockRows(folder.objects_lock)
    except TrilightError:
        return None
    known = facts.lock_sha256, facts.lock_bytes, facts.asked
    if known != (publication.manifest.objects_lock_sha256, lock.num_bytes, order.digest):
        return None
    found = accept_maps(order.own, order.settings, workers=order.workers)
    maps = tuple(row for row in found.rows if lock.find(row[0].uid) == row[0])
    if len(maps) != facts.num_maps:  # the long way says which one has changed
        return None
    return AcceptedObjects(
        num_objects=facts.num_objects,
        num_found=facts.num_found,
        pool=order.pool,
        maps=maps,
    )
