"""Stage "assets": every object becomes a prepared asset or a rejection, each made only once."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.assets.recipe import methods_of
from pipeline.assets.settings import AssetSettings
from pipeline.assets.store import AssetStore
from pipeline.isolation import ChildFailed, IsolatedChild
from storage.asset import Asset, Level, decode_asset
from storage.digests import sha256_hex
from storage.errors import Rejected
from storage.records import Failure, ObjectRecord

if TYPE_CHECKING:
    from pipeline.assets.prepare import AssetAttempt

BorrowChild = Callable[[], AbstractContextManager[IsolatedChild]]

_MAY_PASS = ("killed", "out_of_memory", "timeout_wall", "crashed", "exception")
"""What may go better on another day or machine, so that it is not remembered of the object."""


@dataclass(frozen=True, kw_only=True)
class PreparedAsset:
    """An accepted object."""

    record: ObjectRecord
    """Identity and rights."""
    path: Path
    """Its asset file in the store."""
    asset_sha256: str
    """Digest of that file."""
    geometry_sha256: str
    """Digest of its cleaned geometry."""


def prepare_assets(
    records: list[ObjectRecord],
    settings: AssetSettings,
    store: AssetStore,
    *,
    borrow_child: BorrowChild,
    workers: int,
    done: Callable[[], None],
) -> tuple[list[PreparedAsset], list[Failure]]:
    """Prepare every object in isolated children; returns both lists in the order of `records`.

    Args:
        records: the objects.
        settings: profile, budgets and limits.
        store: where outcomes are kept, and found again.
        borrow_child: lends a child with the limits of this stage.
        workers: objects at a time.
        done: called after each object, from any thread.

    Raises:
        TrilightError: the store cannot be written, or a needed library is not installed.
    """
    methods = methods_of(settings.profile)

    def prepare(record: ObjectRecord) -> PreparedAsset | Failure:
        try:
            return _prepare_once(record, settings, store, methods, borrow_child)
        except Rejected as rejection:
            return _failure(record, rejection.reason, rejection.message)
        finally:
            done()

    with ThreadPoolExecutor(workers) as threads:
        outcomes = list(threads.map(prepare, records))
    prepared = [outcome for outcome in outcomes if isinstance(outcome, PreparedAsset)]
    return prepared, [outcome for outcome in outcomes if isinstance(outcome, Failure)]


def _prepare_once(
    record: ObjectRecord,
    settings: AssetSettings,
    store: AssetStore,
    methods: tuple[str, ...],
    borrow_child: BorrowChild,
) -> PreparedAsset:
    """Find or make the outcome of an object; raises Rejected where it is a refusal."""
    source = Path(record.path)
    try:
        key = store.key(source, settings)
    except OSError as error:
        raise Rejected("unreadable_file", f"cannot be read ({error.strerror})") from error
    path = store.asset_path(key)
    with store.making(key):
        if refusal := store.refusal(key):
            raise refusal
        if not path.exists():
            try:
                with borrow_child() as child:
                    asset = _by_any_method(child, source, settings, methods)
            except (Rejected, ChildFailed) as error:
                if error.reason not in _MAY_PASS:
                    store.refuse(key, error.reason, error.message)
                raise Rejected(error.reason, error.message) from error
            store.keep(key, asset)
    data = path.read_bytes()
    return PreparedAsset(
        record=record,
        path=path,
        asset_sha256=sha256_hex(data),
        geometry_sha256=decode_asset(data).geometry_sha256,
    )


def _by_any_method(
    child: IsolatedChild, source: Path, settings: AssetSettings, methods: tuple[str, ...]
) -> Asset:
    """Try the methods in turn, each in a fresh child, for the levels that are still missing.

    Raises:
        Rejected: the object is unusable, or no level passed the gate: then as the first method
            failed at the largest budget.
        ChildFailed: every method killed its child.
    """
    asset: Asset | None = None
    levels: list[Level] = []
    first_miss: tuple[str, str] | None = None
    death: ChildFailed | None = None
    missing, waiting = settings.budgets, list(methods)
    while waiting:
        method = waiting.pop(0)
        finest = missing[0] == settings.budgets[0]  # epsilon is about this level
        wanted = dataclasses.replace(
            settings, budgets=missing, epsilon=settings.epsilon if finest else None
        )
        try:
            attempt = child.call(attempt_in_child, source, wanted, method)
        except ChildFailed as failure:
            death = failure
            continue
        asset = attempt.asset
        if attempt.method in waiting:  # it stood in for what is not safe for this mesh
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
    return dataclasses.replace(asset, levels=_rising(levels))


def _rising(levels: list[Level]) -> tuple[Level, ...]:
    """Return the levels from the largest budget, without those that waste theirs.

    Another method may leave fewer faces at a budget than the first one at a smaller budget.
    """
    kept: list[Level] = []
    for level in sorted(levels, key=lambda level: level.record.budget):
        if not kept or len(level.faces) > len(kept[-1].faces):
            kept.append(level)
    return tuple(reversed(kept))


def attempt_in_child(source: Path, settings: AssetSettings, method: str) -> "AssetAttempt":
    """Run the recipe; only here are the mesh libraries imported, and only children come here."""
    from pipeline.assets.prepare import prepare_asset

    return prepare_asset(source, settings, method)


def _failure(record: ObjectRecord, reason: str, message: str) -> Failure:
    return Failure(stage="assets", item=record.uid, reason=reason, message=message)
