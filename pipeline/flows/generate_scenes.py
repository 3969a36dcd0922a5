"""The flow `generate-scenes`: objects, or scenes in files, to shards, resumable at any moment.

Prefect schedules and displays; files are the truth. The flow looks at what is there, makes what is
missing, and publishes each shard as it is done. A task run is one shard: one to a few minutes.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.futures import PrefectFuture, as_completed
from prefect.utilities.annotations import quote

from pipeline.documents.dataset_documents import write_documents
from pipeline.flows.accept_objects import AcceptedObjects, accept_objects
from pipeline.flows.accept_scene_files import accept_scene_files, settings_for_files
from pipeline.flows.builds import BUILDS, frozen_note, named_build, object_source
from pipeline.flows.children import ChildPool
from pipeline.flows.environment import environment
from pipeline.flows.make_scene import SceneSource, set_up_child
from pipeline.flows.make_shard import make_shard
from pipeline.flows.publication import Publication, begin
from pipeline.flows.scene_files import SceneFolder, find_scene_files
from pipeline.flows.settings import BuildSettings
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.renders.variant import Variant, choose_variant
from storage.atomic import remove_leftovers
from storage.dataset import open_dataset
from storage.errors import TrilightError
from storage.layout import DatasetFolder
from storage.manifest import ShardEntry
from storage.statistics import Statistics

Argument = TypeVar("Argument")

_RENDER_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=3600, calls_per_child=200)
"""A scene at 4096 samples and 512 pixels takes minutes; a render child holds below 1 GiB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What a run of the flow leaves behind."""

    digest: str
    """The dataset digest."""
    num_objects_found: int
    """Objects in the source, or the files that scenes are made of."""
    num_objects_used: int
    """Objects that scenes may draw from."""
    num_scenes_given_up: int
    """Scenes that no attempt could save."""
    statistics: Statistics
    """What the dataset holds."""
    notes: tuple[str, ...] = ()
    """What a person should know: fields of scene files that are unknown, cameras that were not
    used, and whether a frozen set is the published one."""


@flow(name="generate-scenes", persist_result=False, validate_parameters=True)
def generate_scenes(
    build: str = "smoke",
    objects: str | None = None,
    out: str = "data/smoke",
    scenes: int | None = None,
    seed: int | None = None,
    resolution: int | None = None,
    noise_floor_db: float | None = None,
    allow_licences: list[str] | None = None,
    licence: str | None = None,
    workers: int = 1,
    failure_budget: float = 0.1,
    accept_environment: bool = False,
    scenes_from: str | None = None,
    views: int | None = None,
    changes: dict[str, Any] | None = None,
) -> Outcome:
    """Make a dataset, or what is missing of it.

    With `scenes_from`, scene k is the k-th `*.json` of a folder, with the first of its cameras, and
    all are of the split `test`; the build's limits on scenes do not apply.

    Args:
        build: name of the settings, such as `smoke`.
        objects: a folder of 3D objects here or on a server, `builtin:` for procedural ones, or
            `objaverse:`; by default what the build demands, or else `builtin:`.
        out: folder of the dataset.
        scenes: how many scenes, rounded up to whole shards; by default the build's number.
        seed: replaces the build's seed.
        resolution: replaces the build's picture width in pixels.
        noise_floor_db: replaces the build's target (psnr_log_db).
        allow_licences: licences allowed in addition to the build's.
        licence: of object files that come without any statement; otherwise they count as yours.
        workers: render processes; each takes its share of the cores.
        failure_budget: share of scenes that may be given up before the run stops.
        accept_environment: go on with a dataset that was begun with other library versions.
        scenes_from: folder of scene files (RenderFormer JSON) to render instead of new scenes.
        views: cameras of each scene file; by default as many as every file has.
        changes: other settings of the build by dotted name, such as `scenes.lights.count`.

    Raises:
        TrilightError: what the user can mend; what is finished is safe.
    """
    settings = named_build(
        build,
        seed=seed,
        resolution=resolution,
        noise_floor_db=noise_floor_db,
        allow_licences=tuple(allow_licences or ()),
        changes=changes,
    )
    if workers < 1:
        raise TrilightError(f"workers is {workers}; expected at least 1.")
    listed = _listed(scenes_from, objects, scenes)
    source = object_source(settings, objects)
    settings = settings_for_files(settings, listed, views)
    folder = DatasetFolder(Path(out).resolve())
    with folder.locked():
        remove_leftovers(folder.root)
        variant = choose_variant()
        count = BUILDS[build].num_scenes if scenes is None else scenes
        publication = begin(
            folder, settings, environment(variant), count, accept_environment=accept_environment
        )
        accepted = (
            read_scenes_task(_whole(listed), licence, _whole(settings), _whole(publication))
            if listed
            else prepare_assets_task(
                source, licence, _whole(settings), _whole(publication), workers
            )
        )
        _make_shards(settings, variant, publication, accepted, workers, failure_budget)
        statistics = write_documents_task(_whole(publication))
    return Outcome(
        digest=publication.manifest.dataset_digest,
        num_objects_found=accepted.num_found,
        num_objects_used=len(accepted.objects),
        num_scenes_given_up=publication.num_given_up(),
        statistics=statistics,
        notes=listed.notes(settings.scenes.num_views) if listed else frozen_note(build, statistics),
    )


def _listed(scenes_from: str | None, objects: str | None, scenes: int | None) -> SceneFolder | None:
    """Return the scene files that were asked for."""
    if scenes_from is None:
        return None
    if objects is not None or scenes is not None:
        raise TrilightError(
            f"--scenes-from {scenes_from} was given with --objects or --scenes; expected neither: "
            "the files say both."
        )
    return find_scene_files(scenes_from)


@task(name="prepare-assets", cache_policy=NO_CACHE)
def prepare_assets_task(
    source: str,
    licence: str | None,
    settings: BuildSettings,
    publication: Publication,
    workers: int,
) -> AcceptedObjects:
    """Turn the source into the frozen objects of the dataset."""
    return accept_objects(source, licence, settings, publication, workers)


@task(name="read-scenes", cache_policy=NO_CACHE)
def read_scenes_task(
    folder: SceneFolder,
    licence: str | None,
    settings: BuildSettings,
    publication: Publication,
) -> AcceptedObjects:
    """Build every scene of the folder once, and freeze its files."""
    return accept_scene_files(folder, licence, settings, publication)


@task(name="make-shard", cache_policy=NO_CACHE)
def make_shard_task(shard_index: int, job: "_ShardJob") -> ShardEntry:
    """Make one shard with a borrowed render child."""
    with job.pool.borrow() as child:
        settings = job.settings
        return make_shard(job.folder, settings.splits, settings.storage.profile, shard_index, child)


@task(name="write-documents", cache_policy=NO_CACHE)
def write_documents_task(publication: Publication) -> Statistics:
    """Write what people and hubs look at."""
    return write_documents(open_dataset(str(publication.folder.root)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _ShardJob:
    """What the shard tasks of one run share."""

    folder: DatasetFolder
    settings: BuildSettings
    pool: ChildPool


def _make_shards(
    settings: BuildSettings,
    variant: Variant,
    publication: Publication,
    accepted: AcceptedObjects,
    workers: int,
    failure_budget: float,
) -> None:
    missing = publication.missing_shards()
    if not missing:
        return
    source = SceneSource(
        settings=settings,
        variant=variant,
        threads=max(1, (os.cpu_count() or 1) // workers),
        objects=accepted.objects,
        files=accepted.files,
    )

    def render_child() -> IsolatedChild:
        return IsolatedChild(limits=_RENDER_LIMITS, setup=set_up_child, setup_args=(source,))

    pool = ChildPool(render_child, min(workers, len(missing)))
    job = _ShardJob(folder=publication.folder, settings=settings, pool=pool)
    try:
        for shard in _in_window(missing, job, window=min(workers, len(missing))):
            publication.add_shard(shard)
            _require_within_budget(publication, failure_budget)
    finally:
        pool.close()


def _in_window(missing: list[int], job: _ShardJob, *, window: int) -> Iterator[ShardEntry]:
    """Yield shards as they are done, with at most `window` task runs at a time.

    The bound keeps the flow's memory constant, and no finished shard waits for a slow one.
    """
    waiting = iter(missing)
    running: list[PrefectFuture[ShardEntry]] = []
    while True:
        for shard_index in waiting:
            running.append(make_shard_task.submit(shard_index, _whole(job)))
            if len(running) == window:
                break
        if not running:
            return
        done = next(iter(as_completed(running)))
        running.remove(done)
        yield done.result()


def _whole(argument: Argument) -> Argument:
    """Hand an argument to a task as it is; Prefect otherwise searches all of it for futures."""
    return cast(Argument, quote(argument))


def _require_within_budget(publication: Publication, failure_budget: float) -> None:
    given_up = publication.num_given_up()
    if given_up > failure_budget * publication.manifest.num_scenes:
        raise TrilightError(
            f"{publication.folder.root}: {given_up} of {publication.manifest.num_scenes} scenes "
            f"could not be made, more than the failure budget of {failure_budget:.0%}. The reasons "
            f"are in {publication.folder.failures.name}; mend them, or raise --failure-budget."
        )
