"""The render children of this process: made at the first task of a job, warm for the next ones."""

import contextlib
import threading
from collections.abc import Iterator, Mapping
from typing import Any

from pipeline.builds.settings import differences
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.making.attempt_scene import SceneRecipe, set_up_child
from pipeline.making.children import ChildPool
from pipeline.making.environment import environment
from pipeline.making.machine import cores_owned, visible_gpus
from pipeline.making.run import ShardJob
from pipeline.renders.variant import choose_variant
from storage.errors import TrilightError
from storage.extensions import recorded, require_same_extensions

_RENDER_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=200)
"""A scene at 4096 samples and 512 pixels takes minutes; a render child holds below 1 GiB."""
_CARD_LIMITS = ChildLimits(memory_bytes=1 << 46, wall_s=3600, calls_per_child=200)
"""CUDA reserves addresses for all memory of card and machine."""

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
def render_child(job: ShardJob) -> Iterator[IsolatedChild]:
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

    def new_child(number: int) -> IsolatedChild:
        source = SceneRecipe(
            settings=job.settings,
            variant=variant,
            threads=cores_of_child(job),
            gpu=cards[number % len(cards)] if cards else None,
            pool=job.accepted.pool,
            maps=job.accepted.maps,
            files=job.accepted.files,
            revisited=job.accepted.revisited,
            folder=job.folder,
        )
        limits = _CARD_LIMITS if on_card else _RENDER_LIMITS
        return IsolatedChild(limits=limits, setup=set_up_child, setup_args=(source,))

    return ChildPool(new_child, job.num_at_once)


def cores_of_child(job: ShardJob) -> int:
    """Return how many threads a render child of this process has."""
    return max(1, cores_owned() // job.num_at_once)


def require_environment(expected: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    """Raise TrilightError where a machine would make other bytes than the dataset's."""
    for name, wanted, found in differences(expected, here):
        raise TrilightError(
            f"this worker differs from the machine that began the run: {name} is {found!r}; "
            f"expected {wanted!r}. Use machines of one kind and one image, or accept pictures that "
            "agree only within their noise floors with --accept-environment."
        )
