"""The mesh stage in children with limits, with the shared asset store."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedAsset, prepare_assets
from pipeline.assets.store import AssetStore
from pipeline.isolation import NO_FILES, ChildLimits, IsolatedChild, Reach, preload, reach
from pipeline.making.children import ChildPool
from storage.cache import cache_folder
from storage.errors import TrilightError
from storage.installation import module_name
from storage.records.objects import Failure, ObjectRecord

_LIMITS = ChildLimits(memory_bytes=5 << 30, wall_s=300, cpu_s=60, calls_per_child=50)
"""Measured on 148 objects and 78 hostile files: a usable mesh takes seconds and far below 1 GiB.
The wall time only ends what waits without working; a busy machine does not decide who passes."""


def asset_store() -> AssetStore:
    """Return the store of this user: below TRILIGHT_CACHE, or ~/.cache/trilight."""
    return AssetStore(cache_folder("assets"))


def asset_child(confined_to: Reach = NO_FILES) -> IsolatedChild:
    """Return a child for mesh work, which may read these files, and what it is let by `may`."""
    preload_mesh_libraries()
    return IsolatedChild(limits=_LIMITS, setup=require_filters, confined_to=confined_to)


def preload_mesh_libraries() -> None:
    """Have every new child begin with the mesh libraries; call before the first one starts."""
    names = ("pipeline.assets.prepare", "pipeline.assets.decimation.pymeshlab_filters")
    preload([module_name(name) for name in names])


class MeshWork:
    """Children for mesh work that several batches of objects share; a context that ends them."""

    def __init__(self, settings: AssetSettings, workers: int) -> None:
        """Remember what to do; a child is started where an object needs one.

        Args:
            settings: of the mesh stage.
            workers: objects at a time.
        """
        self._settings, self._workers = settings, workers
        self._pool = ChildPool(lambda _: asset_child(), workers)

    def prepare(
        self, records: list[ObjectRecord], done: Callable[[], None]
    ) -> tuple[list[PreparedAsset], list[Failure]]:
        """Prepare objects; arguments and errors as `prepare_assets`; from any thread."""
        places = {place for one in records for place in (one.path, one.root) if place}
        all_files = reach(files=map(Path, sorted(places)))

        @contextlib.contextmanager
        def borrow() -> Iterator[IsolatedChild]:
            with self._pool.borrow() as child:
                child.may(all_files)  # at once: a child is replaced for a file that it may not read
                yield child

        return prepare_assets(
            records,
            self._settings,
            asset_store(),
            borrow_child=borrow,
            workers=self._workers,
            done=done,
        )

    def __enter__(self) -> "MeshWork":
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.close()


def prepare_isolated(
    records: list[ObjectRecord],
    settings: AssetSettings,
    *,
    workers: int,
    done: Callable[[], None],
) -> tuple[list[PreparedAsset], list[Failure]]:
    """Prepare objects in `workers` children; arguments and errors as `prepare_assets`."""
    with MeshWork(settings, workers) as work:
        return work.prepare(records, done)


def require_filters() -> None:
    """Stop the run where pymeshlab is broken: that is no fault of the objects.

    Raises:
        TrilightError: pymeshlab is installed and lacks a filter that we use.
    """
    from pipeline.assets.environment import missing_filters

    if missing := missing_filters():
        raise TrilightError(
            f"pymeshlab lacks {', '.join(missing)}: a system library is missing. Run "
            "`trilight doctor`, which names it, or `make setup`."
        )
