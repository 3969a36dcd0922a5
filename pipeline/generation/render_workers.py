"""Pools of worker processes that make scenes, started by the first task of a job, then kept warm.

A worker also prepares a frozen object again if its prepared file is missing on its machine.
Render children get composed scenes, which are trusted. If scenes come from files, another child
reads these, confined to their folder (pipeline.isolation.confinement).
"""

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from pipeline.exchange.scene_files import SceneFiles
from pipeline.generation.freeze_objects import require_tried
from pipeline.generation.generation_run import ShardJob
from pipeline.generation.prepare_isolated import asset_child, asset_store, mesh_stage
from pipeline.generation.scene_origins import ComposedScenes, changed_error
from pipeline.generation.scene_worker import SceneWorker
from pipeline.isolation import ChildLimits, ChildPool, IsolatedChild, call_with_retries, reach
from pipeline.objects.sources import ListedObjects, list_objects
from pipeline.renders.mitsuba_variant import choose_variant, environment, visible_gpus
from storage.atomic import write_atomically
from storage.digests import sha256_of_file
from storage.errors import TrilightError
from storage.extensions import extension_digests, require_same_extensions
from storage.machine import available_cores
from storage.records.objects import LockRows, ObjectRecord
from storage.records.scene import Scene
from storage.remote.url import safe_url
from storage.settings.overrides import differences

_RENDER_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=200)
"""A scene at 4096 samples and 512 pixels takes minutes, and a render child holds below 1 GiB: the
limits on memory and wall time end only a child that leaks or hangs. After 200 calls a fresh child
starts, so that leaks stay bounded."""


class _JobChildren:
    """The children that make the scenes of one job."""

    def __init__(self, job: ShardJob) -> None:
        self.num_users = 0
        """Number of tasks that use them."""
        self.renderers = _render_pool(job)
        self.readers: ChildPool | None = None
        if isinstance(files := job.accepted.origin, SceneFiles):
            folder = reach([files.root])
            self.readers = ChildPool(lambda _: asset_child(folder), job.num_at_once)

    def close(self) -> None:
        self.renderers.close()
        if self.readers:
            self.readers.close()


_jobs: dict[tuple[str, ...], _JobChildren] = {}
_jobs_lock = threading.RLock()


def close_children(*, of_idle_jobs: bool = False) -> None:
    """End the children of this process at once, or only those of jobs without a task at work."""
    with _jobs_lock:
        for key, children in [*_jobs.items()]:
            if not (of_idle_jobs and children.num_users):
                _jobs.pop(key).close()


@contextlib.contextmanager
def job_children(
    job: ShardJob,
) -> Iterator[tuple[IsolatedChild, Callable[[int], Scene] | None]]:
    """Lend a render child, and a function that reads a scene file by its index.

    The function is None if scenes are not read from files; it raises as `SceneFiles.scene`, and
    ChildFailed. The first task of a job creates its children and ends idle ones.
    """
    key = (str(job.folder.root), job.settings.digest, job.lock_sha256, job.device)
    with _jobs_lock:
        if key not in _jobs:
            close_children(of_idle_jobs=True)
            _jobs[key] = _JobChildren(job)
        children = _jobs[key]
        children.num_users += 1
    try:
        with contextlib.ExitStack() as lent:
            child = lent.enter_context(children.renderers.borrow())
            read = None
            if children.readers:
                reader = lent.enter_context(children.readers.borrow())
                read = functools.partial(_read_scene, job, reader)
            yield child, read
    finally:
        with _jobs_lock:
            children.num_users -= 1


def _read_scene(job: ShardJob, reader: IsolatedChild, index: int) -> Scene:
    settings = job.settings
    arguments = (settings.assets, settings.scenes.num_views, settings.seed)
    scene: Scene = call_with_retries(
        reader, SceneFiles.scene, job.accepted.origin, index, *arguments
    )
    scene.check()  # here: a compromised child may send anything
    return scene


def _render_pool(job: ShardJob) -> ChildPool:
    require_same_extensions("this worker: the dataset", job.extensions, extension_digests("data"))
    variant = choose_variant(device=job.device)
    begun_in = job.environment
    for name, old, new in differences(begun_in, environment(variant)) if begun_in else ():
        raise TrilightError(
            f"this worker differs from the machine that began the run: {name} is {new!r}; "
            f"expected {old!r}. Use machines of one kind and one image, or accept pictures that "
            "agree only within their stated errors with --accept-environment."
        )
    gpus = visible_gpus() if variant.device == "gpu" else ()
    memory_bytes = variant.address_space(_RENDER_LIMITS.memory_bytes)
    limits = replace(_RENDER_LIMITS, memory_bytes=memory_bytes)
    same = (job.settings, job.accepted.origin, asset_store(), variant, cores_of_child(job))

    def new_child(number: int) -> IsolatedChild:
        gpu = gpus[number % len(gpus)] if gpus else None
        return IsolatedChild(limits=limits, factory=SceneWorker, args=(*same, gpu, job.folder))

    return ChildPool(new_child, job.num_at_once)


def cores_of_child(job: ShardJob) -> int:
    """Return the number of threads of a render child of this process."""
    return max(1, available_cores() // job.num_at_once)


def restore_object(job: ShardJob, uid: str, asset_name: str) -> None:
    """Make the prepared file of an object again; its digest must be the one in the lock.

    Args:
        asset_name: name of its file in the dataset's index.

    Raises:
        TrilightError: the source has lost or changed the object.
        EnvironmentFailure: it could not be prepared this time.
    """
    frozen = job.accepted.origin
    assert isinstance(frozen, ComposedScenes), "only composed scenes draw objects"
    store = asset_store()
    display_name = f"objects {safe_url(frozen.source)!r}"
    locked = LockRows(frozen.lock).find(uid)
    path = store.asset_path(asset_name)
    settings = job.settings
    with contextlib.suppress(FileNotFoundError):
        if locked is not None and sha256_of_file(path) == locked.asset_sha256:
            return  # another worker was faster
    path.unlink(missing_ok=True)
    work_dir = job.folder.staged_objects
    record = find_object(frozen.source, frozen.licence, work_dir, settings.allowed_licences, uid)
    if record is None or locked is None:
        raise changed_error(display_name, uid, "is missing or no longer usable")
    with mesh_stage(settings.mesh_settings, workers=1) as prepare:
        prepared, rejected = prepare([record], lambda: None)
    if rejected:
        require_tried(display_name, rejected[0])
    if not prepared or prepared[0].asset_sha256 != locked.asset_sha256:
        raise changed_error(display_name, uid, "has changed" if prepared else "is no longer usable")
    if prepared[0].asset_name != asset_name:  # a later recipe gives it another name
        write_atomically(path, store.asset_path(prepared[0].asset_name).read_bytes())


def find_object(
    source: str, licence: str | None, work_dir: Path, allowed: tuple[str, ...], uid: str
) -> ObjectRecord | None:
    """Return an object of a source, with its file on this machine; None if the source lacks it."""
    for _ in range(2):  # the cached list may be older than the file
        listed = _list_source(source, licence, work_dir, allowed)
        for record in listed.fetch_selected(lambda other: other == uid).records:
            if Path(record.path).exists():
                return record
        _list_source.cache_clear()
    return None


@functools.lru_cache(maxsize=1)
def _list_source(
    source: str, licence: str | None, work_dir: Path, allowed: tuple[str, ...]
) -> ListedObjects:
    """Return the objects of a source; cached, so that many missing objects cost one listing."""
    return list_objects(source, work_dir=work_dir, allowed_licences=allowed, licence=licence)
