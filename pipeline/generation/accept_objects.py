"""Freezes the objects of a source; if they are frozen already, loads the lock and its index."""

import shutil
import threading
from collections.abc import Callable, Container, Sequence
from dataclasses import replace
from operator import attrgetter

from pipeline.generation.accept_maps import AcceptedMaps, accept_maps
from pipeline.generation.freeze_objects import (
    AcceptedObjects,
    freeze_objects,
    read_frozen_objects,
    require_same,
)
from pipeline.generation.object_batches import (
    ObjectWork,
    PrepareResult,
    cut_objects,
    prepare_in_batches,
)
from pipeline.generation.object_options import ObjectOptions
from pipeline.generation.scene_origin import ComposedScenes
from pipeline.objects.listing import Fetched
from pipeline.objects.sources import ListedObjects
from storage.dataset.layout import DatasetFolder
from storage.dataset.progress import announce_downloads, announce_objects, count_object
from storage.errors import TrilightError
from storage.records.lock_rows import LockRows
from storage.records.object_index import ObjectIndex
from storage.records.objects import OBJECT, LockedObject, ObjectRecord
from storage.remote.safe_url import safe_url


def prepare_unfrozen_objects(options: ObjectOptions) -> ListedObjects | None:
    """Prepare objects cooperatively, without holding the objects lock, unless they are frozen.

    Returns:
        The listed source, for `accept_objects`; None if the objects are frozen already.

    Raises:
        TrilightError: as `list_objects` and `prepare_in_batches`.
    """
    writer = options.writer
    folder = writer.folder
    with folder.mutex("objects"):  # one worker writes built-in objects, the others load them
        writer.refresh()
        writer.fetch_lock()
        if read_frozen_objects(writer) is not None:
            return None
        listed = options.list_source()
        announce_objects(folder, len(listed.allowed))
    _prepare(
        listed,
        listed.allowed,
        options,
        should_stop=lambda: writer.is_published(folder.staged_index),
    )
    return listed


def accept_objects(options: ObjectOptions, listed: ListedObjects | None = None) -> AcceptedObjects:
    """Prepare the meshes of a source and freeze them; later, load those that were frozen.

    The user's textures and maps are frozen with them. Call while holding the mutex `objects`.

    Args:
        options: source, licences and settings of the objects.
        listed: the listed source, if it is known.

    Raises:
        TrilightError, EnvironmentFailure: as `list_objects` and `freeze_objects`.
    """
    settings = options.settings
    folder = options.writer.folder
    if trusted := load_trusted_objects(options):
        return trusted
    frozen = read_frozen_objects(options.writer)
    shared = listed is not None
    listed = listed or options.list_source()
    maps = _select_frozen_maps(
        accept_maps(options.user_folders, settings, workers=options.workers), options, frozen
    )
    selected = listed.allowed
    if frozen is not None:
        selected = _select_frozen_batches(frozen, selected)
        announce_objects(folder, len(selected))
    prepared, rejected = _prepare(listed, selected, options, retry_transient=not shared)
    lost = [failure for failure in rejected if failure.stage == "objects"]
    listed.require_some(len(selected) - len(lost), [*listed.refused, *lost])
    if frozen is not None:
        prepared = [one for one in prepared if one.record.uid in frozen]
        rejected = [failure for failure in rejected if failure.item in frozen]
    accepted = freeze_objects(
        options, prepared, [*listed.refused, *rejected], listed.num_found, maps
    )
    shutil.rmtree(folder.staged_batches, ignore_errors=True)
    return accepted


def _select_frozen_maps(
    maps: AcceptedMaps, options: ObjectOptions, frozen: dict[str, LockedObject] | None
) -> AcceptedMaps:
    """Return the maps that the dataset was begun with; all if it begins now."""
    if frozen is None:
        return maps
    rows = tuple(row for row in maps.rows if row[0].uid in frozen)
    of_maps = {uid: entry for uid, entry in frozen.items() if entry.kind != OBJECT}
    require_same(safe_url(options.source), of_maps, [entry for entry, _ in rows])
    return replace(maps, rows=rows)


def _select_frozen_batches(
    frozen: Container[str], records: list[ObjectRecord]
) -> list[ObjectRecord]:
    """Return the records that share a batch with a frozen object: it may be prepared already."""
    batches = cut_objects(sorted(records, key=attrgetter("uid")))
    return [one for batch in batches if any(r.uid in frozen for r in batch) for one in batch]


def _prepare(
    listed: ListedObjects,
    records: Sequence[ObjectRecord],
    options: ObjectOptions,
    should_stop: Callable[[], bool] = lambda: False,
    retry_transient: bool = True,
) -> PrepareResult:
    folder = options.writer.folder
    downloads = _Downloads(listed, folder, len(records))
    work = ObjectWork(
        settings=options.settings.mesh_settings,
        writer=options.writer,
        fetch=None if listed.listing.is_local else downloads.fetch,
    )
    return prepare_in_batches(
        sorted(records, key=attrgetter("uid")),
        work,
        workers=options.workers,
        done=lambda count: count_object(folder, count),
        should_stop=should_stop,
        retry_transient=retry_transient,
    )


class _Downloads:
    """Downloads objects and announces the progress over all batches of this worker."""

    def __init__(self, listed: ListedObjects, folder: DatasetFolder, total: int) -> None:
        self._listed = listed
        self._folder = folder
        self._total = total
        self._mutex = threading.Lock()
        self._done = 0

    def fetch(self, records: list[ObjectRecord]) -> Fetched:
        return self._listed.fetch(records, self._announce)

    def _announce(self, done_of_batch: int, batch: int) -> None:
        with self._mutex:
            self._done += done_of_batch > 0
            announce_downloads(self._folder, self._done, self._total)


def load_trusted_objects(options: ObjectOptions) -> AcceptedObjects | None:
    """Return the frozen objects by their index, without opening any of them.

    The lock has their digests, which are checked when a scene draws an object. None if nothing is
    frozen yet, the lock has no index, or the source differs from the frozen one: then every object
    has to be checked.

    Raises:
        TrilightError: as `accept_maps`.
    """
    writer = options.writer
    folder = writer.folder
    writer.fetch_lock()
    try:
        facts = ObjectIndex(folder.staged_index).facts
        lock = LockRows(folder.objects_lock)
    except TrilightError:
        return None
    known = facts.lock_sha256, facts.lock_bytes, facts.asked
    if known != (writer.manifest.objects_lock_sha256, lock.num_bytes, options.digest):
        return None
    accepted_maps = accept_maps(options.user_folders, options.settings, workers=options.workers)
    maps = tuple(row for row in accepted_maps.rows if lock.find(row[0].uid) == row[0])
    if len(maps) != facts.num_maps:  # the long way says which one has changed
        return None
    return AcceptedObjects(
        num_objects=facts.num_objects,
        num_found=facts.num_found,
        origin=ComposedScenes(pool=options.pool, maps=maps),
    )
