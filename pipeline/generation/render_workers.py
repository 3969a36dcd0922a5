"""Pools of worker processes that make scenes, started by the first task of a job, then kept warm.

Render children get composed scenes, which are trusted. If scenes come from files, another child
reads these, confined to their folder (pipeline.isolation.confinement).
"""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.scene_files import SceneFiles
from pipeline.generation.generation_run import ShardJob
from pipeline.generation.prepare_isolated import asset_child
from pipeline.generation.scene_worker import SceneRecipe, SceneWorker
from pipeline.generation.software_environment import environment
from pipeline.isolation import ChildLimits, ChildPool, IsolatedChild, call_with_retries, reach
from pipeline.presets.settings import differences
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.visible_gpus import visible_gpus
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.machine import available_cores
from storage.records.scene import Scene

_RENDER_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=200)
"""A scene at 4096 samples and 512 pixels takes minutes, and a render child holds below 1 GiB: the
limits on memory and wall time end only a child that leaks or hangs. After 200 calls a fresh child
starts, so that leaks stay bounded."""

_pools: dict[tuple[str, ...], ChildPool] = {}
_pools_lock = threading.Lock()


def close_children() -> None:
    """End the render children of this process at once."""
    with _pools_lock:
        for pool in _pools.values():
            pool.close()
        _pools.clear()


def close_idle_children() -> None:
    """End the render children of this process that no task uses; other jobs may run here."""
    with _pools_lock:
        _close_idle()


def _close_idle(keep: tuple[str, ...] = ()) -> None:
    idle = [key for key, pool in _pools.items() if pool.num_users == 0]
    for key in idle:
        if not keep or key[: len(keep)] != keep:
            _pools.pop(key).close()


@contextlib.contextmanager
def render_child(job: ShardJob) -> Iterator[IsolatedChild]:
    """Lend a render child; the first task of a job creates its pool and ends idle ones."""
    with _borrow_child((), job, _render_pool) as child:
        yield child


@contextlib.contextmanager
def scene_reader(job: ShardJob) -> Iterator[Callable[[int], Scene] | None]:
    """Lend a function that reads a scene file by its index; None if scenes are composed.

    The function raises as `SceneFiles.scene`, and ChildFailed.
    """
    files = job.accepted.origin
    settings = job.settings
    if not isinstance(files, SceneFiles):
        yield None
        return
    folder = reach(files=[files.root])

    def new_pool(job: ShardJob) -> ChildPool:
        return ChildPool(lambda _: asset_child(folder), job.num_at_once)

    with _borrow_child(("files",), job, new_pool) as child:

        def read(index: int) -> Scene:
            num_views = settings.scenes.num_views
            seed = settings.seed
            arguments = (files, index, settings.assets, num_views, seed)
            scene = call_with_retries(child, scene_of_file, *arguments)
            scene.check()  # here: a compromised child may send anything
            return scene

        yield read


def scene_of_file(
    files: SceneFiles, scene_index: int, assets: AssetSettings, num_views: int, seed: int
) -> Scene:
    """Read a scene; runs only in child processes. Raises as `SceneFiles.scene`."""
    return files.scene(scene_index, assets, num_views=num_views, seed=seed)


@contextlib.contextmanager
def _borrow_child(
    kind: tuple[str, ...], job: ShardJob, make: Callable[[ShardJob], ChildPool]
) -> Iterator[IsolatedChild]:
    of_job = (str(job.folder.root), job.settings.digest, job.lock_sha256, job.device)
    key = (*of_job, *kind)
    with _pools_lock:
        if key not in _pools:
            _close_idle(keep=of_job)
            _pools[key] = make(job)
        pool = _pools[key]
        pool.num_users += 1
    try:
        with pool.borrow() as child:
            yield child
    finally:
        with _pools_lock:
            pool.num_users -= 1


def _render_pool(job: ShardJob) -> ChildPool:
    require_same_extensions("this worker: the dataset", job.extensions, extension_digests("data"))
    variant = choose_variant(device=job.device)
    if job.environment:
        require_environment(job.environment, environment(variant))
    gpus = visible_gpus() if variant.device == "gpu" else ()
    memory_bytes = variant.address_space(_RENDER_LIMITS.memory_bytes)

    def new_child(number: int) -> IsolatedChild:
        recipe = SceneRecipe(
            settings=job.settings,
            variant=variant,
            threads=cores_of_child(job),
            gpu=gpus[number % len(gpus)] if gpus else None,
            origin=job.accepted.origin,
            folder=job.folder,
        )
        limits = replace(_RENDER_LIMITS, memory_bytes=memory_bytes)
        return IsolatedChild(limits=limits, factory=SceneWorker, args=(recipe,))

    return ChildPool(new_child, job.num_at_once)


def cores_of_child(job: ShardJob) -> int:
    """Return the number of threads of a render child of this process."""
    return max(1, available_cores() // job.num_at_once)


def require_environment(expected: Mapping[str, Any], actual: Mapping[str, Any]) -> None:
    """Raise TrilightError if this machine would make other bytes than the dataset's."""
    for name, old, new in differences(expected, actual):
        raise TrilightError(
            f"this worker differs from the machine that began the run: {name} is {new!r}; "
            f"expected {old!r}. Use machines of one kind and one image, or accept pictures that "
            "agree only within their stated errors with --accept-environment."
        )
