"""`ObjectLock`: freezes the objects of a dataset, or loads those that are frozen.

The frozen objects are the pool that its scenes draw from, equal for all workers. The user's
textures and environment maps are frozen with them. Each of their files is decoded once, in a child
with limits; the result is in the user's cache. The digest of its content decides the split of a
texture or map, by the rule of objects.
"""

import contextlib
import logging
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path

from pipeline.assets.stage import PreparedObject
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.object_batches import ObjectWork, cut_objects, prepare_in_batches
from pipeline.generation.prepare_isolated import PrepareResult, format_unread, write_unread
from pipeline.generation.scene_origins import AcceptedObjects, ComposedScenes, require_same
from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    ChildPool,
    IsolatedChild,
    call_with_retries,
    is_transient,
    reach,
)
from pipeline.objects.listing import failure
from pipeline.objects.maps.listing import PLURALS, FoundMap, find_maps
from pipeline.objects.maps.prepared import decode_prepared, map_cache_key, prepare_map
from pipeline.objects.sources import ListedObjects, list_objects
from pipeline.presets.settings import DatasetSettings
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.conventions import SPLITS
from storage.dataset.progress import announce_downloads, announce_objects, count_object
from storage.dataset.splits import require_objects, split_of_object, split_of_shard
from storage.digests import canonical_json, sha256_hex
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.machine import available_cores
from storage.records.object_index import ObjectIndex, write_object_index
from storage.records.objects import (
    OBJECT,
    TEXTURE,
    Failure,
    LockedObject,
    LockRows,
    ObjectRecord,
    count_by_reason,
    failure_of,
)
from storage.remote.url import printable, safe_url

log = logging.getLogger("trilight.objects")

_MAP_LIMITS = ChildLimits(memory_bytes=8 << 30, wall_s=600, cpu_s=300, calls_per_child=200)
"""The largest map, 8192 x 4096 in float32, takes 403 MB, and its mip levels six times as much."""


@dataclass(frozen=True, kw_only=True)
class AcceptedMaps:
    """The user's textures and environment maps that scenes may use."""

    rows: tuple[tuple[LockedObject, Path], ...] = ()
    """Every usable texture and map with its prepared file."""
    failures: tuple[Failure, ...] = ()
    """Reasons why other files cannot be used, or not fully."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectLock:
    """The objects of a dataset: their source, and what freezes them."""

    source: str
    """Source of the objects, as `list_objects` takes it; may hold a secret."""
    licence: str | None
    """Licence that the user states for files without one."""
    settings: DatasetSettings
    """Settings of the preset: how objects are prepared and assigned to splits."""
    writer: DatasetWriter
    """Writer of the dataset that the objects are frozen for."""
    map_folders: Mapping[str, str] = field(default_factory=dict)
    """Folders of textures and maps by kind, which are frozen with the objects."""
    map_licence: str | None = None
    """Licence that the user states for these folders where they have no catalogue."""

    def accept(self) -> AcceptedObjects:
        """Return the frozen objects; prepare and freeze them with the other workers if need be.

        The user's textures and maps are frozen with them.

        Raises:
            TrilightError, EnvironmentFailure: as `list_objects`, `prepare_in_batches`,
                `accept_maps` and `freeze_prepared`.
        """
        if trusted := self.load():
            return trusted
        writer = self.writer
        listed = None
        with writer.hold_lock("objects"):  # one writes built-in objects, the others load them
            writer.fetch_lock()
            if writer.frozen_objects() is None:
                listed = self._list_source()
                announce_objects(writer.folder, len(listed.records))
        if listed:  # together with the other workers, so without the lock
            index = writer.folder.staged_index
            self._prepare(listed, listed.records, should_stop=lambda: writer.is_published(index))
        with writer.hold_lock("objects"):  # one worker freezes, and the others load it
            return self.load() or self._freeze(
                listed or self._list_source(), retry_transient=listed is None
            )

    def load(self) -> AcceptedObjects | None:
        """Return the frozen objects by their index, without opening any of them.

        The lock has their digests, which are checked when a scene draws an object. None if nothing
        is frozen yet, the lock has no index, or the source differs from the frozen one: then every
        object has to be checked.

        Raises:
            TrilightError: as `accept_maps`.
        """
        folder = self.writer.folder
        self.writer.fetch_lock()
        try:
            facts = ObjectIndex(folder.staged_index).facts
            lock = LockRows(folder.objects_lock)
        except TrilightError:
            return None
        known = facts.lock_sha256, facts.lock_bytes, facts.asked
        if known != (self.writer.manifest.objects_lock_sha256, lock.num_bytes, self._digest):
            return None
        maps = tuple(row for row in self.accept_maps().rows if lock.find(row[0].uid) == row[0])
        if len(maps) != facts.num_maps:  # the long way says which one has changed
            return None
        return self._frozen_inputs(facts.num_objects, facts.num_found, maps)

    def _freeze(self, listed: ListedObjects, *, retry_transient: bool) -> AcceptedObjects:
        """Freeze the objects of the source, or check each of those that were frozen."""
        folder = self.writer.folder
        frozen = self.writer.frozen_objects()
        maps = self.accept_maps()
        selected = listed.records
        if frozen is not None:
            maps = replace(maps, rows=tuple(row for row in maps.rows if row[0].uid in frozen))
            of_maps = {uid: entry for uid, entry in frozen.items() if entry.kind != OBJECT}
            require_same(self._display_name, of_maps, [entry for entry, _ in maps.rows])
            # whole batches: one that holds a frozen object may be prepared already
            batches = cut_objects(sorted(selected, key=attrgetter("uid")))
            batches = [batch for batch in batches if any(one.uid in frozen for one in batch)]
            selected = [one for batch in batches for one in batch]
            announce_objects(folder, len(selected))
        prepared, rejected = self._prepare(listed, selected, retry_transient=retry_transient)
        lost = [failure for failure in rejected if failure.stage == "objects"]
        listed.require_some(len(selected) - len(lost), [*listed.failures, *lost])
        if frozen is not None:
            prepared = [one for one in prepared if one.record.uid in frozen]
            rejected = [failure for failure in rejected if failure.item in frozen]
        accepted = self.freeze_prepared(
            prepared,
            [*listed.failures, *rejected],
            len(listed.records) + len(listed.failures),
            maps,
        )
        shutil.rmtree(folder.staged_batches, ignore_errors=True)
        return accepted

    def freeze_prepared(
        self,
        prepared: list[PreparedObject],
        rejected: list[Failure],
        num_found: int,
        maps: AcceptedMaps,
    ) -> AcceptedObjects:
        """Freeze the objects in the first run; in later runs require that they are the same.

        Args:
            prepared: objects that the mesh stage accepted; in later runs the frozen ones of them.
            rejected: rejections by the source and by the mesh stage.

        Raises:
            TrilightError: no object is accepted, a split has none, or the objects are not those
                that the dataset was begun with.
            EnvironmentFailure: a frozen object could not be prepared this time.
        """
        writer = self.writer
        splits = self.settings.splits
        display_name = self._display_name
        frozen = writer.frozen_objects()
        transient = [failure for failure in rejected if is_transient(failure.reason)]
        if frozen is not None:
            for failure in transient:
                require_tried(display_name, failure)
        writer.add_failures([*rejected, *maps.failures])
        objects = [
            LockedObject(
                **asset.record.identity,
                asset_sha256=asset.asset_sha256,
                split=split_of_object(asset.geometry_sha256, splits),
            )
            for asset in prepared
        ]
        locked = [*objects, *(entry for entry, _ in maps.rows)]
        if frozen is None:
            if not objects:
                raise TrilightError(
                    f"{display_name}: none was accepted; expected at least one usable object with "
                    f"an allowed licence. The reasons are in {writer.folder.failures}."
                )
            shards = range(writer.num_shards)
            require_objects(
                {split: sum(entry.split == split for entry in objects) for split in SPLITS},
                {split_of_shard(index, splits) for index in shards},
            )
            self._warn(prepared, transient)
            writer.lock_objects(locked)
        else:
            require_same(display_name, frozen, locked)
        self._write_index(prepared, num_found)
        return self._frozen_inputs(len(objects), num_found, maps.rows)

    def _warn(self, prepared: list[PreparedObject], transient: list[Failure]) -> None:
        """Log what the accepted objects lack, and which others may be tried again."""
        display_name = self._display_name
        if transient:
            counts = (f"{count} x {why}" for _, why, count in count_by_reason(transient))
            log.warning(
                "%s: %d could not be prepared this time (%s), each after several tries, "
                "and the dataset is begun without them; failures.jsonl names them. A dataset begun "
                "later tries them again.",
                display_name,
                len(transient),
                ", ".join(counts),
            )
        drawn = {each.record.uid: (each.without_own,) for each in prepared if each.without_own}
        unread = {each.record.uid: each.unread for each in prepared if each.unread}
        for name, notes, what in (
            ("drawn_materials", drawn, _DRAWN),
            ("unread", unread, "have parts that are not read"),
        ):
            path = write_unread(self.writer.folder.logs, notes, name)
            if notes:
                log.warning(
                    "%s: %d of %d %s:\n%s",
                    display_name,
                    len(notes),
                    len(prepared),
                    what,
                    "\n".join(format_unread(notes, path)),
                )

    def _frozen_inputs(
        self, num_objects: int, num_found: int, maps: tuple[tuple[LockedObject, Path], ...]
    ) -> AcceptedObjects:
        folder = self.writer.folder
        origin = ComposedScenes(
            lock=folder.objects_lock,
            index=folder.staged_index,
            source=self.source,
            licence=self.licence,
            maps=maps,
        )
        return AcceptedObjects(num_objects=num_objects, num_found=num_found, origin=origin)

    @property
    def _digest(self) -> str:
        """Digest of source and licence: with another one, every object is checked again."""
        return sha256_hex(canonical_json([self.source, self.licence]))

    @property
    def _display_name(self) -> str:
        return f"objects {safe_url(self.source)!r}"

    def accept_maps(self) -> AcceptedMaps:
        """Prepare the textures and maps of the folders.

        Raises:
            TrilightError: a folder is missing or empty, none of its files can be used, or the cache
                cannot be written.
        """
        licence = self.map_licence
        allowed = self.settings.allowed_licences
        rows: list[tuple[LockedObject, Path]] = []
        failures: list[Failure] = []
        for kind, folder in self.map_folders.items():
            maps, refused = find_maps(kind, folder, licence=licence, allowed_licences=allowed)
            outcomes = _prepare_maps(kind, maps, self.settings)
            usable = [outcome for outcome in outcomes if not isinstance(outcome, Failure)]
            failures += [
                failure(locked.uid, "not_read", notes.read_text("utf-8"))
                for locked, path in usable
                if (notes := _notes(path)).exists()
            ]
            lost = [outcome for outcome in outcomes if isinstance(outcome, Failure)]
            failures += [*refused, *lost]
            if not usable:
                first = (*lost, *refused)[0]
                raise TrilightError(
                    f"{PLURALS[kind]}: none of {len(lost) + len(refused)} files can be "
                    f"used; the first is {first.item}: {first.reason} ({first.message}). Fix or "
                    "replace it."
                )
            _warn_of_maps(kind, [locked for locked, _ in usable], lost)
            rows += usable
        return AcceptedMaps(rows=tuple(rows), failures=tuple(failures))

    def _list_source(self) -> ListedObjects:
        return list_objects(
            self.source,
            work_dir=self.writer.folder.staged_objects,
            allowed_licences=self.settings.allowed_licences,
            licence=self.licence,
        )

    def _prepare(
        self,
        listed: ListedObjects,
        records: Sequence[ObjectRecord],
        should_stop: Callable[[], bool] = lambda: False,
        retry_transient: bool = True,
    ) -> PrepareResult:
        folder = self.writer.folder
        mutex = threading.Lock()
        num_downloaded = 0

        def announce(done_of_batch: int, batch: int) -> None:
            nonlocal num_downloaded  # over all batches of this worker
            with mutex:
                num_downloaded += done_of_batch > 0
                announce_downloads(folder, num_downloaded, len(records))

        work = ObjectWork(
            settings=self.settings.mesh_settings,
            writer=self.writer,
            fetch=listed.fetch and (lambda of_batch: listed.fetch(of_batch, announce)),
        )
        return prepare_in_batches(
            sorted(records, key=attrgetter("uid")),
            work,
            workers=available_cores(),
            done=lambda count: count_object(folder, count),
            should_stop=should_stop,
            retry_transient=retry_transient,
        )

    def _write_index(self, prepared: list[PreparedObject], num_found: int) -> None:
        """Write the index of the lock, by which later workers load it without opening objects."""
        folder = self.writer.folder
        by_uid = sorted(prepared, key=attrgetter("record.uid"))
        write_object_index(
            folder.staged_index,
            folder.objects_lock,
            ((each.asset_name, each.least_triangles) for each in by_uid),
            query_sha256=self._digest,
            num_found=num_found,
        )
        self.writer.publish(folder.staged_index)


_DRAWN = (
    "have no materials of their own at every level and get drawn ones there. `trilight assets "
    "--own-materials` says what was found in each"
)


def require_tried(display_name: str, failure: Failure) -> None:
    """Raise EnvironmentFailure if a frozen object failed for a transient reason."""
    if is_transient(failure.reason):
        raise EnvironmentFailure(
            f"{display_name}: {failure.item!r}, which the dataset was begun with, could not be "
            f"prepared this time ({failure.reason}: {failure.message}). Nothing has changed; run "
            "the same command again."
        )


def _prepare_maps(
    kind: str, maps: Sequence[FoundMap], settings: DatasetSettings
) -> list[tuple[LockedObject, Path] | Failure]:
    scenes = settings.scenes
    workers = available_cores()
    size = scenes.textures.surfaces.size if kind == TEXTURE else scenes.skies.maps.height
    all_files = reach(path for user_map in maps for path in user_map.files.values())

    def prepare(user_map: FoundMap) -> tuple[LockedObject, Path] | Failure:
        try:
            with pool.borrow() as child:
                path = _prepare_file(kind, user_map.files, size, child)
            data = path.read_bytes()
            content_sha256 = decode_prepared(data, path.name).content_sha256
        except Rejected as rejection:
            return failure_of("objects", user_map.record.uid, rejection)
        locked = LockedObject(
            **user_map.record.identity,
            asset_sha256=sha256_hex(data),
            split=split_of_object(content_sha256, settings.splits),
            kind=kind,
        )
        return locked, path

    children = ChildPool(
        lambda _: IsolatedChild(limits=_MAP_LIMITS, confined_to=all_files), workers
    )
    with contextlib.closing(children) as pool, ThreadPoolExecutor(workers) as threads:
        return list(threads.map(prepare, maps))


def _notes(prepared: Path) -> Path:
    """Return the path of the note on unread parts of a prepared file; absent if there are none."""
    return prepared.with_suffix(".txt")


def _prepare_file(kind: str, files: Mapping[str, Path], size: int, child: IsolatedChild) -> Path:
    """Prepare a file in a child unless the cache has it; return its path. Raises Rejected."""
    name = map_cache_key(kind, files, size)
    path = cache_folder("maps") / name[:2] / f"{name}.safetensors"
    if not path.exists():
        try:
            data, unread = call_with_retries(child, prepare_map, kind, files, size)
        except ChildFailed as failure:
            raise Rejected(failure.reason, failure.sentence) from failure
        if map_cache_key(kind, files, size) != name:
            raise Rejected("unreadable_file", "it changed while it was being prepared")
        if unread:
            message = printable(f"it is used without {'; '.join(unread)}")
            write_atomically(_notes(path), message.encode())
        write_atomically(path, data)
    return path


def _warn_of_maps(kind: str, locked: Sequence[LockedObject], lost: Sequence[Failure]) -> None:
    if lost:
        first = lost[0]
        log.warning(
            "%s: %d cannot be used, such as %s (%s: %s); failures.jsonl names all",
            PLURALS[kind],
            len(lost),
            first.item,
            first.reason,
            first.message,
        )
    without = [split for split in SPLITS if split not in {entry.split for entry in locked}]
    if without and {entry.split for entry in locked} != {"test"}:
        log.warning(
            "%s: of %d, none belongs to %s, whose scenes get procedural ones; about 30 different "
            "ones are enough for every split",
            PLURALS[kind],
            len(locked),
            " and ".join(without),
        )
