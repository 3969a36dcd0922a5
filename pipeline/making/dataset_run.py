"""A run: from an order to a dataset, or to a part of one. Resumable at any moment, by anybody.

Files are the truth. A run looks at what is there, makes what is missing, and leaves each shard as
it is done; several runs on one folder share the work (storage.claims), and those on one
bucket what is finished (pipeline.shards.mirror). Who runs the tasks is not known here: `trilight
generate` uses threads, the flows Prefect.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from pipeline.builds.named import BUILDS, frozen_note, named_build, object_source
from pipeline.builds.settings import BuildSettings
from pipeline.documents.dataset_documents import write_documents
from pipeline.exchange.scene_folder import SceneFolder, find_scene_files
from pipeline.making.accept_objects import AcceptedObjects, accept_objects
from pipeline.making.accept_scene_files import accept_scene_files, settings_for_files
from pipeline.making.bucket_publication import begin_dataset, joined
from pipeline.making.environment import environment
from pipeline.making.machine import cores_owned, visible_gpus
from pipeline.making.make_shard import is_free
from pipeline.making.make_task import ShardJob, TaskOutcome, close_children
from pipeline.making.order import DatasetOrder
from pipeline.making.order_words import generate_words
from pipeline.making.pieces import TaskSizes, TasksLeft
from pipeline.making.publication import Publication
from pipeline.making.runners import Runner
from pipeline.objects.sources import look_at_source
from pipeline.renders.variant import choose_variant
from storage.dataset.asked import write_asked
from storage.dataset.layout import DatasetFolder, dataset_folder
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError

_FIRST_PAUSE_S = 1.0
_LONGEST_PAUSE_S = 60.0
"""Between two looks at what others are making; it doubles as long as nothing is left for us."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What a run leaves behind."""

    digest: str
    """The dataset digest, of the shards that are there."""
    num_objects_found: int
    """Objects in the source, or the files that scenes are made of."""
    num_objects_used: int
    """Objects that scenes may draw from."""
    num_scenes_given_up: int
    """Scenes that no attempt could save."""
    num_shards: int
    """Shards that are there."""
    num_shards_planned: int
    """Shards of the finished dataset."""
    statistics: Statistics | None
    """What the dataset holds; None where it is not finished."""
    notes: tuple[str, ...] = ()
    """What a person should know: fields of scene files that are unknown, cameras that were not
    used, and whether a frozen set is the published one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """An order that is begun: what every step of it needs."""

    order: DatasetOrder
    """What was asked for."""
    settings: BuildSettings
    """The build with the order's changes."""
    listed: SceneFolder | None
    """The scene files, where scenes come from files."""
    publication: Publication
    """What is public of the dataset."""
    accepted: AcceptedObjects
    """What scenes are made of."""


Watcher = Callable[[Run, TaskOutcome], None]
"""Called after each task."""


def make_dataset(
    order: DatasetOrder, runner: Runner, watch: Watcher = lambda run, outcome: None
) -> Outcome:
    """Make a dataset, or what is missing of it, or of a range of its shards.

    Raises:
        TrilightError: what the user can mend; what is finished is safe.
    """
    folder = _folder(order)
    settings, listed = _settings(order)
    with joined(folder):
        run = _begin(order, settings, listed, folder)
        try:
            _make_missing(run, runner, watch)
        finally:
            close_children()
        finished = not run.publication.missing_shards()
        _require_within_budget(run)  # of earlier runs too
        run.publication.publish()
        statistics = runner.finish(lambda: _documents(run.publication)) if finished else None
    return _outcome(run, statistics)


def prepare_dataset(order: DatasetOrder) -> Run:
    """Begin a dataset and freeze its objects, without a picture."""
    folder = _folder(order)
    settings, listed = _settings(order)
    with joined(folder):
        return _begin(order, settings, listed, folder)


def _folder(order: DatasetOrder) -> DatasetFolder:
    folder = dataset_folder(order.place)
    return replace(folder, root=folder.root.resolve())


def _settings(order: DatasetOrder) -> tuple[BuildSettings, SceneFolder | None]:
    settings = named_build(
        order.build,
        seed=order.seed,
        resolution=order.resolution,
        noise_floor_db=order.noise_floor_db,
        allow_licences=order.allow_licences,
        changes=order.changes,
    )
    source = object_source(settings, order.objects)  # refuse before anything is written
    files = order.scenes_from
    listed = None if files is None else find_scene_files(files, order.albedo_over_one)
    if listed is None and not _folder(order).manifest.exists():
        look_at_source(source, allowed_licences=settings.allowed_licences, licence=order.licence)
    return settings_for_files(settings, listed, order.views), listed


def _begin(
    order: DatasetOrder, settings: BuildSettings, listed: SceneFolder | None, folder: DatasetFolder
) -> Run:
    publication = begin_dataset(
        folder,
        settings,
        environment(choose_variant()),
        BUILDS[order.build].num_scenes if order.scenes is None else order.scenes,
        accept_environment=order.accept_environment,
    )
    _require_shards(order, publication)
    with folder.turn("objects"):  # one maker prepares, and the others find it done
        publication.refresh()
        if listed:
            accepted = accept_scene_files(listed, order.licence, settings, publication)
        else:
            source = object_source(settings, order.objects)
            accepted = accept_objects(source, order.licence, settings, publication, cores_owned())
        write_asked(folder, generate_words(order))
    return Run(
        order=order, settings=settings, listed=listed, publication=publication, accepted=accepted
    )


def _require_shards(order: DatasetOrder, publication: Publication) -> None:
    wanted = order.shard_range()
    if wanted is not None and wanted.start >= publication.num_shards:
        raise TrilightError(
            f"shards is {order.shards!r}; expected one that begins below {publication.num_shards}, "
            f"the shards of {publication.manifest.num_scenes} scenes."
        )


def _make_missing(run: Run, runner: Runner, watch: Watcher) -> None:
    """Make what is missing, and wait for what others are making, or make that too if they die.

    A range leaves to others what they are at.
    """
    order, publication = run.order, run.publication
    wanted = order.shard_range()
    sizes, tasks, pause_s = TaskSizes(), TasksLeft(), _FIRST_PAUSE_S
    num_at_once = runner.num_at_once or _workers(order)
    job = ShardJob(
        folder=publication.folder,
        settings=run.settings,
        environment={} if order.accept_environment else publication.manifest.environment,
        accepted=run.accepted,
        lock_sha256=publication.manifest.objects_lock_sha256,
        num_at_once=num_at_once,
        extensions=publication.manifest.extensions,
    )
    while missing := [
        index for index in publication.missing_shards() if wanted is None or index in wanted
    ]:
        made = 0
        at_once = runner.window or num_at_once
        cut = tasks.cut(missing, run.settings.splits, sizes, at_once=at_once)
        for outcome in runner.run(cut, job):
            made += outcome.scenes + len(outcome.shards)
            if outcome.scenes:
                sizes.measured(outcome.scenes, outcome.seconds)
            for shard in outcome.shards:
                publication.add_shard(shard)
            watch(run, outcome)
            _require_within_budget(run)
        if made == 0 and wanted is not None:
            return
        pause_s = _FIRST_PAUSE_S if made else _wait_for_others(run, pause_s)


def _wait_for_others(run: Run, pause_s: float) -> float:
    """Return when something is missing that nobody is at, or nothing; and the next pause.

    Only then tasks are handed out again: each is a row of a scheduler's database.
    """
    folder, settings = run.publication.folder, run.settings
    while True:
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        missing = run.publication.missing_shards()
        if not missing or any(is_free(folder, settings, index) for index in missing):
            return pause_s


def _workers(order: DatasetOrder) -> int:
    if order.workers is not None:
        return order.workers
    return max(1, len(visible_gpus())) if choose_variant().name == "cuda_ad_rgb" else 1


def _documents(publication: Publication) -> Statistics:
    with publication.folder.turn("documents"):
        statistics = write_documents(publication.dataset(), publication.folder)
        publication.send_documents()
        return statistics


def _outcome(run: Run, statistics: Statistics | None) -> Outcome:
    publication, listed = run.publication, run.listed
    notes: tuple[str, ...] = ()
    if listed and run.accepted.files:
        notes = (*run.accepted.files.notes, *listed.notes(run.settings.scenes.num_views))
    elif statistics:
        notes = frozen_note(run.order.build, statistics)
    return Outcome(
        digest=publication.manifest.dataset_digest,
        num_objects_found=run.accepted.num_found,
        num_objects_used=len(run.accepted.objects),
        num_scenes_given_up=publication.num_given_up(),
        num_shards=len(publication.manifest.shards),
        num_shards_planned=publication.num_shards,
        statistics=statistics,
        notes=notes,
    )


def _require_within_budget(run: Run) -> None:
    """Raise TrilightError where too many scenes failed; files that nothing is made of are none."""
    publication, files = run.publication, run.accepted.files
    num_scenes, budget = publication.manifest.num_scenes, run.order.failure_budget
    given_up = publication.num_given_up()
    if given_up > budget * num_scenes + (len(files.unusable) if files else 0):
        raise TrilightError(
            f"{publication.folder.shown}: {given_up} of {num_scenes} scenes could not be made, "
            f"more than the failure budget of {budget:.0%}. The reasons are in "
            f"{publication.folder.failures.name}; mend them, or raise --failure-budget."
        )
