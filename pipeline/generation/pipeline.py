"""The whole pipeline on one page: from a source of objects to a dataset for training.

    step       what comes out                                        who does it
    ---------  ----------------------------------------------------  ------------------------------
    objects    files whose licence allows their use                  pipeline.objects.sources
    meshes     the same objects, cleaned, with fewer triangles       pipeline.assets.stage
    scenes     meshes with a room, materials, lights and cameras     pipeline.scenes.compose
    renders    a picture of each camera, down to the stated error     pipeline.renders.renderer
    shards     tars of finished scenes, the same bytes everywhere    pipeline.shards.pack_shards
    documents  card, report and contact sheet for readers            pipeline.documents

The objects are frozen after the mesh stage (scene files instead, if scenes come from files; the
objects of a finished dataset, if its scenes are revisited). From then on scene k is a function of
the settings, the frozen objects and k alone, whichever worker makes it. A `Runner` makes many
scenes at the same time (`make_shards`): on threads, in a Slurm array, with Prefect, on a Dask
cluster (pipeline.executors.registry lists them). Native code runs in child processes, so that a
crash costs one attempt.

The files on disk are the only state, and every step may be killed at any moment. A mesh is kept in
the asset store, a scene in the staging folder, a shard in the dataset; the next run looks for these
and makes the rest. Several runs on one folder share the work (storage.file_locks), and those on one
bucket share batches of objects (storage.remote.store) and shards (pipeline.shards.pack_shards).
"""

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.sheets import write_first_pictures
from pipeline.generation.dataset_writer import DatasetWriter
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import (
    FIRST_PAUSE_S,
    Outcome,
    Piece,
    Run,
    Runner,
    ShardJob,
    TaskCutter,
    TaskResult,
    Watcher,
    begin_run,
    wait_for_others,
)
from pipeline.generation.render_workers import (
    close_children,
    cores_of_child,
    job_children,
    restore_object,
)
from pipeline.generation.scene_worker import MAX_ATTEMPTS, SceneWorker
from pipeline.isolation import ChildFailed, IsolatedChild, with_retries
from pipeline.shards.pack_shards import UnfinishedShard
from storage.dataset.manifest import ShardEntry
from storage.dataset.statistics import Statistics
from storage.errors import Rejected, TrilightError
from storage.records.objects import Failure, failure_of
from storage.records.sample import Sample, sample_key
from storage.records.scene import Scene


def make_dataset(
    options: GenerateOptions, runner: Runner, watch: Watcher = lambda run, outcome: None
) -> Outcome:
    """Make a dataset: all its missing shards, or those of a range.

    Args:
        options: the dataset, and the range of shards to make.
        runner: runs the tasks.
        watch: called after each task.

    Raises:
        TrilightError: an error that the user can fix; finished scenes stay on disk.
    """
    with begin_run(options) as run:  # objects, meshes
        make_shards(run, runner, watch)  # scenes, renders, shards
        finished = run.publication.finish()
        run.require_within_budget()
        statistics = None
        if finished and not run.publication.left_to_others:
            statistics = runner.finish(lambda: make_documents(run.publication))
    return run.outcome(finished, statistics)


def prepare_dataset(options: GenerateOptions) -> Run:
    """Begin a dataset and freeze its objects, without rendering; raises as `make_dataset`."""
    with begin_run(options) as run:
        return run


def make_shards(run: Run, runner: Runner, watch: Watcher) -> None:
    """Turn frozen meshes into shards: the runner calls `make_task` for many tasks in parallel.

    A round has a task for each scene that is missing now. After it, and where no scene was free,
    the run waits for the scenes of other workers; a run of a range of shards ends instead.

    Raises:
        TrilightError: too many scenes failed, or as a task.
        EnvironmentFailure: the run has submitted its maximum number of tasks.
    """
    writer = run.publication
    job = replace(run.job, num_at_once=runner.num_at_once or run.job.num_at_once)
    cutter = TaskCutter(at_once=runner.window or job.num_at_once)
    pause_s = FIRST_PAUSE_S
    try:
        while missing := run.unfinished_shards():
            has_progress = False
            for outcome in runner.run(cutter.cut_round(missing, writer.splits), job):  # parallel
                cutter.record(outcome)
                has_progress |= bool(outcome.scenes or outcome.shards)
                for shard in outcome.shards:
                    writer.add_shard(shard)
                watch(run, outcome)
                run.require_within_budget()
            if has_progress:
                pause_s = FIRST_PAUSE_S
            elif run.options.shards is None:
                pause_s = wait_for_others(run, pause_s)
            else:  # others are making all that is left of the range
                return
    finally:
        close_children()


def make_task(job: ShardJob, pieces: tuple[Piece, ...]) -> TaskResult:
    """Make the scenes of some pieces, and pack the shards that are complete then.

    A runner calls this for each task, on a thread, in another process or on another machine.
    Finished scenes are not made again.

    Raises:
        TrilightError: the output cannot be written, or this machine would make other bytes.
    """
    started = time.monotonic()
    with job_children(job) as (child, read):
        made = [make_piece(job, piece, child, read) for piece in pieces]
    seconds = time.monotonic() - started
    return TaskResult(
        shards=tuple(shard for _, shard in made if shard),
        scenes=sum(scenes for scenes, _ in made),
        seconds=seconds,
        core_s=seconds * cores_of_child(job),
    )


def make_piece(
    job: ShardJob,
    piece: Piece,
    child: IsolatedChild,
    read: Callable[[int], Scene] | None = None,
) -> tuple[int, ShardEntry | None]:
    """Make the missing scenes of a piece, and pack its shard if that is complete then.

    Scenes claimed by other workers are skipped; the worker that stages the last scene packs. A
    scene that cannot be made is no error: the shard omits it, and failures.jsonl has the reason.

    Returns:
        Number of scenes made or given up here, and the shard if this call packed it.
    """
    splits = job.settings.splits
    profile = job.settings.storage.profile
    shard = UnfinishedShard(job.folder, splits, piece.shard_index)
    scenes = 0
    attempts = 1 if read else MAX_ATTEMPTS  # a file is always the same
    for scene_index in range(piece.first, piece.last):
        with shard.claim(scene_index) as ours:
            if not ours:
                continue
            began = time.monotonic()
            restore = partial(restore_object, job)
            sample, failures = make_scene(shard.split, scene_index, attempts, child, restore, read)
            shard.stage(
                scene_index, sample, failures, profile, began=began, cores=cores_of_child(job)
            )
            scenes += 1
            if sample and not job.folder.contact_sheet.exists():
                build = job.settings.build
                with contextlib.suppress(TrilightError):  # a courtesy must not end the run
                    write_first_pictures(job.folder, sample, build=build, split=shard.split)
    return scenes, shard.pack()


def make_scene(
    split: str,
    scene_index: int,
    attempts: int,
    child: IsolatedChild,
    restore: Callable[[str, str], None],
    read: Callable[[int], Scene] | None = None,
) -> tuple[Sample | None, list[Failure]]:
    """Compose and render a scene: return the sample of the first accepted attempt, and failures.

    In the child, `SceneWorker.attempt` composes the scene and renders its views; a scene of a file
    is read in another child, by `read`. If a child is killed, crashes or takes too long, the same
    attempt is repeated in a new one. If the prepared file of an object is missing, `restore` makes
    it again for the same attempt.
    """
    failures: list[Failure] = []
    key = sample_key(scene_index)
    for attempt in range(attempts):
        words = (split, scene_index, attempt)
        try:
            from_file = (read(scene_index),) if read else ()
            call = partial(child.call_method, SceneWorker.attempt, *words, *from_file)
            while (tried := with_retries(call)).missing_asset:
                restore(*tried.missing_asset)
        except Rejected as rejection:
            failures.append(failure_of("scenes", key, rejection, attempt))
            continue
        except ChildFailed as failure:
            skip = Rejected("environmental_skip", f"{failure.reason}: {failure.sentence}")
            failures.append(failure_of("renders", key, skip, attempt))
            continue
        failures += tried.failures
        if tried.sample:
            return tried.sample, failures
    return None, failures


def make_documents(writer: DatasetWriter) -> Statistics:
    """Write the documents of all shards; one worker at a time."""
    with writer.folder.mutex("documents"):
        statistics = write_documents(writer.dataset(), writer.folder)
        writer.publish_documents()
        return statistics
