"""One task: some pieces in turn, with a render child that this process keeps warm between tasks."""

import contextlib
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.builds.settings import BuildSettings, differences
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.making.accept_objects import AcceptedObjects
from pipeline.making.children import ChildPool
from pipeline.making.environment import environment
from pipeline.making.machine import cores_owned, visible_gpus
from pipeline.making.make_scene import SceneRecipe, set_up_child
from pipeline.making.make_shard import make_piece
from pipeline.making.pieces import Piece
from pipeline.renders.variant import choose_variant
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import ShardEntry
from storage.dataset.progress import log_scene
from storage.dataset.splits import shard_of_scene
from storage.errors import TrilightError
from storage.extensions import recorded, require_same_extensions
from storage.records.objects import Failure

_RENDER_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=200)
"""A scene at 4096 samples and 512 pixels takes minutes; a render child holds below 1 GiB."""
_CARD_LIMITS = ChildLimits(memory_bytes=1 << 46, wall_s=3600, calls_per_child=200)
"""CUDA reserves addresses for all memory of card and machine."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardJob:
    """What the tasks of a run share; it may travel to another machine of the same kind."""

    folder: DatasetFolder
    """The dataset, at the same place on every machine."""
    settings: BuildSettings
    """The build."""
    environment: Mapping[str, Any]
    """What the dataset was begun with, which every maker must have too; empty to accept any."""
    accepted: AcceptedObjects
    """What scenes are made of; the files are in the shared cache."""
    lock_sha256: str
    """Digest of the frozen objects."""
    num_at_once: int
    """Tasks at a time in one process; they share its cores."""
    extensions: Mapping[str, str]
    """What the dataset was begun with, which every maker must have loaded (storage.extensions)."""


@dataclass(frozen=True, kw_only=True)
class TaskOutcome:
    """What a task has made."""

    shards: tuple[ShardEntry, ...]
    """The shards that it packed."""
    scenes: int
    """Scenes that it made or gave up; others were there, or are made elsewhere."""
    seconds: float
    """Wall time."""
    core_s: float
    """The same times the cores of the render child."""


def make_task(job: ShardJob, pieces: tuple[Piece, ...]) -> TaskOutcome:
    """Make some pieces; what is there already is not made again.

    Raises:
        TrilightError: as `make_piece`, or this machine would make other bytes.
    """
    started, scenes = time.monotonic(), 0
    cores = cores_of_child(job)

    def log(scene_index: int, seconds: float, failures: list[Failure]) -> None:
        nonlocal scenes
        scenes += 1
        name = shard_of_scene(scene_index, job.settings.splits)
        log_scene(
            job.folder, name, scene_index, seconds=seconds, cores=cores, num_rejected=len(failures)
        )

    with _child_of(job) as child:
        packed = [make_piece(job.folder, job.settings, piece, child, log) for piece in pieces]
    seconds = time.monotonic() - started
    return TaskOutcome(
        shards=tuple(shard for shard in packed if shard),
        scenes=scenes,
        seconds=seconds,
        core_s=seconds * cores,
    )


_pools: dict[tuple[str, str, str], ChildPool] = {}
_pools_lock = threading.Lock()


def close_children() -> None:
    """End the render children of this process at once."""
    with _pools_lock:
        for pool in _pools.values():
            pool.close()
        _pools.clear()


def close_idle_children() -> None:
    """End the render children of this process that no task uses; others may be at work here."""
    with _pools_lock:
        _close_idle()


def _close_idle() -> None:
    for key in [key for key, pool in _pools.items() if pool.num_users == 0]:
        _pools.pop(key).close()


@contextlib.contextmanager
def _child_of(job: ShardJob) -> Iterator[IsolatedChild]:
    """Lend a child for a job, made at its first task; idle ones of other jobs end then."""
    key = (str(job.folder.root), job.settings.digest, job.lock_sha256)
    with _pools_lock:
        if key not in _pools:
            _close_idle()
            _pools[key] = _new_pool(job)
        pool = _pools[key]
        pool.num_users += 1
    try:
        with pool.borrow() as child:
            yield child
    finally:
        with _pools_lock:
            pool.num_users -= 1


def _new_pool(job: ShardJob) -> ChildPool:
    require_same_extensions("this worker: the dataset", job.extensions, recorded("data"))
    variant = choose_variant()
    if job.environment:
        require_environment(job.environment, environment(variant))
    on_card = variant.name == "cuda_ad_rgb"
    cards = visible_gpus() if on_card else ()

    def render_child(number: int) -> IsolatedChild:
        source = SceneRecipe(
            settings=job.settings,
            variant=variant,
            threads=cores_of_child(job),
            gpu=cards[number % len(cards)] if cards else None,
            objects=job.accepted.objects,
            files=job.accepted.files,
            folder=job.folder,
        )
        limits = _CARD_LIMITS if on_card else _RENDER_LIMITS
        return IsolatedChild(limits=limits, setup=set_up_child, setup_args=(source,))

    return ChildPool(render_child, job.num_at_once)


def cores_of_child(job: ShardJob) -> int:
    """Return how many threads a render child of this process has."""
    return max(1, cores_owned() // job.num_at_once)


def require_environment(expected: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    """Raise TrilightError where a machine would make other bytes than the dataset's."""
    for name, wanted, found in differences(expected, here):
        raise TrilightError(
            f"this worker differs from where the run was started: {name} is {found!r}; expected "
            f"{wanted!r}. Use machines of one kind and one image, or accept pictures that agree "
            "only within their noise floors with --accept-environment."
        )
