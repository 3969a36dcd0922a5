"""Runs the mesh stage in children with limits, with the shared asset store."""

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

from pipeline.assets.asset_store import AssetStore
from pipeline.assets.settings import AssetSettings
from pipeline.assets.stage import PreparedObject, prepare_assets
from pipeline.isolation import (
    NO_FILES,
    ChildLimits,
    ChildPool,
    IsolatedChild,
    Reach,
    preload,
    reach,
)
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.errors import TrilightError
from storage.installation import module_name
from storage.records.objects import Failure, ObjectRecord

_LIMITS = ChildLimits(memory_bytes=5 << 30, wall_s=300, cpu_s=60, calls_per_child=50)
"""Measured on 148 objects and 78 hostile files: a usable mesh takes seconds and far below 1 GiB.
The wall time only ends idle waits; a busy machine does not decide which objects are accepted."""


PrepareResult = tuple[list[PreparedObject], list[Failure]]
Prepare = Callable[[list[ObjectRecord], Callable[[], None]], PrepareResult]
"""Prepares objects, from any thread; arguments and errors as `prepare_assets`."""


def asset_store() -> AssetStore:
    """Return the asset store of this user: below TRILIGHT_CACHE, or ~/.cache/trilight."""
    return AssetStore(cache_folder("assets"))


def asset_child(confined_to: Reach = NO_FILES) -> IsolatedChild:
    """Return a child for mesh work, confined to these files and those of `allow_files`."""
    preload_mesh_libraries()
    return IsolatedChild(limits=_LIMITS, factory=require_filters, confined_to=confined_to)


def preload_mesh_libraries() -> None:
    """Preload the mesh libraries in every new child; call before the first one starts."""
    names = ("pipeline.assets.prepare", "pipeline.assets.decimation.pymeshlab_filters")
    preload([module_name(name) for name in names])


@contextlib.contextmanager
def mesh_stage(settings: AssetSettings, workers: int) -> Iterator[Prepare]:
    """Provide a function that prepares objects, in children that end with the block.

    Args:
        workers: number of objects that are prepared at the same time.
    """

    def prepare(records: list[ObjectRecord], done: Callable[[], None]) -> PrepareResult:
        paths = {path for one in records for path in (one.path, one.root) if path}
        # all files at once: each new file replaces the child
        borrow = partial(pool.borrow, reach(map(Path, sorted(paths))))
        return prepare_assets(
            records, settings, asset_store(), borrow_child=borrow, workers=workers, done=done
        )

    with contextlib.closing(ChildPool(lambda _: asset_child(), workers)) as pool:
        yield prepare


def require_filters() -> None:
    """Stop the run if pymeshlab is broken, which is no fault of the objects.

    Raises:
        TrilightError: pymeshlab is installed and lacks a filter that we use.
    """
    from pipeline.assets.recipe import missing_filters

    if missing := missing_filters():
        raise TrilightError(
            f"pymeshlab lacks {', '.join(missing)}: a system library is missing. Run "
            "`trilight doctor`, which names it, or `make setup`."
        )


UnreadNotes = Mapping[str, tuple[str, ...]]
"""Unread parts of an object's file, as short sentences by the uid of the object."""

_MOST_LINES = 5


def write_unread(logs: Path, unread: UnreadNotes, name: str = "unread") -> Path:
    """Write the sentences by uid to `NAME.json` of a folder; without any, delete the file."""
    path = logs / f"{name}.json"
    if unread:
        write_atomically(path, json.dumps(unread, indent=1, sort_keys=True).encode())
    else:
        path.unlink(missing_ok=True)
    return path


def format_unread(unread: UnreadNotes, path: Path) -> list[str]:
    """Return one line for each of the first objects, and the path that lists the others."""
    lines = [f"{uid}: {', '.join(unread[uid])}" for uid in sorted(unread)[:_MOST_LINES]]
    more = len(unread) - len(lines)
    return [*lines, *([f"and {more} more objects: {path}"] if more > 0 else [])]
