"""Stage "assets": every object becomes a prepared asset or a rejection, each computed once."""

import dataclasses
import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from pipeline.assets.asset_store import AssetStore
from pipeline.assets.recipe import library_versions, methods_of
from pipeline.assets.settings import AssetSettings
from pipeline.foreign.source_file import needs_child, read_source
from pipeline.isolation import ChildFailed, IsolatedChild, call_with_retries
from storage.digests import sha256_hex
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.records.asset import Asset, Level, decode_asset
from storage.records.objects import Failure, ObjectRecord, failure_of

_LOG = logging.getLogger(__name__)

BorrowChild = Callable[[], AbstractContextManager[IsolatedChild]]


@dataclass(frozen=True, kw_only=True, eq=False)
class AssetAttempt:
    """The result of one decimation method for one object."""

    method: str
    """Method that ran: `meshoptimizer` where the requested one is unsafe for this mesh."""
    asset: Asset
    """The asset, with the levels that passed the quality checks; possibly none."""
    missed: Mapping[int, tuple[str, str]]
    """Reason code and message by budget, for the levels that failed."""
    unread: tuple[str, ...] = ()
    """Short sentences, one for each part of the file that no reader handled."""


@dataclass(frozen=True, kw_only=True)
class PreparedObject:
    """An object that the mesh stage has accepted, here or on another machine."""

    record: ObjectRecord
    """Identity and rights of the object."""
    asset_name: str
    """Name of the asset file in the store (AssetStore.asset_path)."""
    asset_sha256: str
    """SHA-256 digest of the asset file, in hex."""
    geometry_sha256: str
    """Digest of the cleaned geometry, in hex."""
    least_triangles: int
    """Triangles of the coarsest level."""
    without_own: str = ""
    """Reason code of missing source materials, where settings keep them; otherwise empty."""
    unread: tuple[str, ...] = ()
    """Short sentences, one for each part of the file that no reader handled."""


def prepare_assets(
    records: list[ObjectRecord],
    settings: AssetSettings,
    store: AssetStore,
    *,
    borrow_child: BorrowChild,
    workers: int,
    done: Callable[[], None],
) -> tuple[list[PreparedObject], list[Failure]]:
    """Prepare every object in isolated children; returns both lists in the order of `records`.

    Args:
        records: the objects; outcomes of earlier runs come from `store`.
        borrow_child: lends a child with the limits of this stage, which may read the objects.
        workers: objects that are prepared at a time.
        done: called after each object, from any thread.

    Raises:
        TrilightError: the store cannot be written, or a needed library is not installed.
    """
    methods = methods_of(settings.profile, settings.decimator, watertight=settings.watertight)
    _LOG.info("prepare %d objects with %s", len(records), library_versions())

    def prepare(record: ObjectRecord) -> PreparedObject | Failure:
        try:
            return _Preparation(record, settings, store, methods, borrow_child).run()
        except Rejected as rejection:
            return failure_of("assets", record.uid, rejection)
        finally:
            done()

    with ThreadPoolExecutor(workers) as threads:
        outcomes = list(threads.map(prepare, records))
    prepared = [outcome for outcome in outcomes if isinstance(outcome, PreparedObject)]
    return prepared, [outcome for outcome in outcomes if isinstance(outcome, Failure)]


@dataclass(frozen=True)
class _Preparation:
    """The preparation of one object."""

    record: ObjectRecord
    settings: AssetSettings
    store: AssetStore
    methods: tuple[str, ...]
    borrow_child: BorrowChild

    def run(self) -> PreparedObject:
        """Load or compute the outcome; raises Rejected where there is no asset."""
        store = self.store
        key = self._key()
        path = store.asset_path(key)
        with store.lock(key):
            if refusal := store.refusal(key):
                raise refusal
            if not path.exists():
                outcome = self._prepare_in_child()
                if self._key() != key:
                    raise Rejected("unreadable_file", "it changed while it was being prepared")
                if isinstance(outcome, Rejected):
                    store.save_refusal(key, outcome.reason, outcome.message)
                    raise outcome
                store.save_asset(key, *outcome)
        data = path.read_bytes()
        asset = decode_asset(data)
        return PreparedObject(
            record=self.record,
            asset_name=key,
            asset_sha256=sha256_hex(data),
            geometry_sha256=asset.geometry_sha256,
            least_triangles=min(len(level.faces) for level in asset.levels),
            without_own="" if asset.materials is None else asset.materials.reason,
            unread=(*store.unread(key), *_list_lost_properties(asset)),
        )

    @property
    def _source(self) -> Path:
        return Path(self.record.path)

    @property
    def _root(self) -> Path | None:
        return Path(self.record.root) if self.record.root else None

    def _key(self) -> str:
        """Return the store's key; raises Rejected where the pre-flight refuses the source."""
        arguments = self._source, self.settings, self._root
        try:
            if not needs_child(self._source):
                kind, digest = source_digest(*arguments)
            else:
                with self.borrow_child() as child:
                    kind, digest = call_with_retries(child, source_digest, *arguments)
        except ChildFailed as failure:
            raise Rejected(failure.reason, failure.sentence) from failure
        except OSError as error:
            raise Rejected("unreadable_file", f"cannot be read ({error.strerror})") from error
        return self.store.key(kind, digest, self.settings)

    def _prepare_in_child(self) -> tuple[Asset, tuple[str, ...]] | Rejected:
        """Return what the store keeps: an asset with its unread parts, or a rejection.

        Raises:
            Rejected: the environment failed; the store keeps nothing, and the next run tries again.
        """
        try:
            with self.borrow_child() as child:
                return self._try_methods(child)
        except Rejected as rejection:
            return rejection
        except ChildFailed as failure:
            refusal = Rejected(failure.reason, failure.sentence)
            if failure.is_verdict:
                return refusal
            raise refusal from failure

    def _try_methods(self, child: IsolatedChild) -> tuple[Asset, tuple[str, ...]]:
        """Try the methods in turn, each in a fresh child, for the levels that are still missing.

        Raises:
            Rejected: the object is unusable; or no level passed the quality checks, then with the
                first method's reason at the largest budget.
            ChildFailed: every method crashed its child or used up its processor time; or a child
                was ended by something else, which says nothing about the method and leads to no
                other.
        """
        asset: Asset | None = None
        unread: tuple[str, ...] = ()
        levels: list[Level] = []
        first_miss: tuple[str, str] | None = None
        death: ChildFailed | None = None
        missing = self.settings.budgets
        waiting = list(self.methods)
        while waiting:
            method = waiting.pop(0)
            settings = dataclasses.replace(self.settings, budgets=missing)
            if missing[0] != self.settings.budgets[0]:  # epsilon is about the finest level
                settings = dataclasses.replace(settings, epsilon=None)
            arguments = self._source, settings, method, self._root
            try:
                attempt = call_with_retries(child, attempt_in_child, *arguments)
            except ChildFailed as failure:
                if not failure.is_verdict:
                    raise
                death = failure
                continue
            materials = None if asset is None else asset.materials
            asset = attempt.asset
            if materials is not None and materials.reason:  # lost in an earlier attempt
                asset = dataclasses.replace(asset, materials=materials)
            unread = attempt.unread
            if attempt.method in waiting:  # it replaced a method that is not safe for this mesh
                waiting = waiting[waiting.index(attempt.method) + 1 :]
            levels += asset.levels
            missing = tuple(budget for budget in missing if budget in attempt.missed)
            if not missing:
                break
            first_miss = first_miss or attempt.missed[missing[0]]
            child.retire()
        if asset is None:
            assert death is not None
            raise death
        if not levels:
            assert first_miss is not None
            raise Rejected(*first_miss)
        return dataclasses.replace(asset, levels=_drop_wasteful_levels(levels)), unread


def _list_lost_properties(asset: Asset) -> list[str]:
    """Return sentences on properties of the source's materials that are not shown."""
    if asset.materials is None:
        return []
    see_through = asset.materials.see_through
    return [
        f"{word} of materials: {'surfaces are opaque' if word in see_through else 'not shown'}"
        for word in asset.materials.lost
    ]


def source_digest(
    source: Path, settings: AssetSettings, root: Path | None = None
) -> tuple[str, str]:
    """Return kind and digest of a source, after the checks that need no mesh library.

    Raises:
        Rejected: as `read_source`.
        OSError: it cannot be read.
    """
    source_file = read_source(source, settings.read_limits, root)
    return source_file.kind, source_file.sha256


def _drop_wasteful_levels(levels: list[Level]) -> tuple[Level, ...]:
    """Return the levels from the largest budget, without those that waste their budget.

    Another method may leave fewer faces at a budget than the first one at a smaller budget.
    """
    useful: list[Level] = []
    for level in sorted(levels, key=lambda level: level.record.budget):
        if not useful or len(level.faces) > len(useful[-1].faces):
            useful.append(level)
    return tuple(reversed(useful))


def attempt_in_child(
    source: Path, settings: AssetSettings, method: str, root: Path | None = None
) -> AssetAttempt:
    """Run the recipe in a child process, the only place that imports the mesh libraries."""
    from pipeline.assets.prepare import prepare_asset

    try:
        return prepare_asset(source, settings, method, root)
    except EnvironmentFailure:
        raise
    except TrilightError as error:  # of its data: that ends no run
        raise Rejected("law_broken", str(error)) from error
