"""The whole line on one page: from a source of objects to a dataset that one can train on.

    step       what comes out                                        who does it
    ---------  ----------------------------------------------------  ------------------------------
    objects    files whose licence allows their use                  pipeline.objects.sources
    meshes     the same objects, cleaned, with fewer triangles       pipeline.assets.stage
    scenes     meshes with a room, materials, lights and cameras     pipeline.scenes.compose
    renders    a picture of each camera, down to the noise floor     pipeline.renders.renderer
    shards     tars of finished scenes, the same bytes everywhere    pipeline.shards.pack
    documents  card, report, contact sheet: what people look at      pipeline.documents

The objects are frozen after the mesh stage (where scenes come from files, the files are; where
they are those of a finished dataset, its objects are). From then on scene k is a function of the
settings, the frozen objects and k, and so it does not matter who makes it. A `Runner` makes many
scenes at the same time (`make_shards`): on threads, in a Slurm array, with Prefect, on a Dask
cluster (pipeline.executors.registry lists them). Native code runs in child processes, so that a
crash costs one attempt.

Files are the truth, and every step may be killed at any moment. A mesh is kept in the asset store,
a scene in the staging folder, a shard in the dataset; the next run looks at what is there and makes
the rest. Several runs on one folder share the work (storage.claims), and those on one bucket share
batches of objects (storage.remote.claims) and what is finished (pipeline.shards.mirror).
"""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from pipeline.builds.named import object_source
from pipeline.builds.settings import BuildSettings
from pipeline.documents.dataset_documents import write_documents
from pipeline.documents.sheets import write_first_pictures
from pipeline.isolation import ChildFailed, IsolatedChild, call_with_retries
from pipeline.making.accept_maps import MapFolders, map_folders
from pipeline.making.accept_objects import accept_objects, share_mesh_work, trusted_objects
from pipeline.making.accept_revisited import accept_revisited
from pipeline.making.accept_scene_files import accept_scene_files
from pipeline.making.asked_objects import AskedObjects
from pipeline.making.attempt_scene import MAX_ATTEMPTS, attempt_scene
from pipeline.making.bucket_publication import joined
from pipeline.making.dataset_order import DatasetOrder, generate_words
from pipeline.making.freeze_objects import AcceptedObjects
from pipeline.making.machine import cores_owned
from pipeline.making.publication import Publication
from pipeline.making.render_children import (
    close_children,
    cores_of_child,
    render_child,
    scene_reader,
)
from pipeline.making.restore_object import restore_object
from pipeline.making.run import (
    Outcome,
    Run,
    ShardJob,
    TaskOutcome,
    Watcher,
    begun_publication,
    settings_of,
)
from pipeline.making.runner import Runner
from pipeline.making.tasks import Piece, rounds
from pipeline.making.unfinished_shard import UnfinishedShard
from storage.dataset.asked import write_asked
from storage.dataset.layout import dataset_folder
from storage.dataset.manifest import ShardEntry
from storage.dataset.statistics import Statistics
from storage.errors import Rejected, TrilightError
from storage.records.objects import Failure
from storage.records.sample import Sample, sample_key
from storage.records.scene import Scene


def make_dataset(
    order: DatasetOrder, runner: Runner, watch: Watcher = lambda run, outcome: None
) -> Outcome:
    """Make a dataset, or what is missing of it, or of a range of its shards.

    Args:
        order: which dataset, and which part of it.
        runner: who runs the tasks.
        watch: called after each task.

    Raises:
        TrilightError: what the user can mend; what is finished is safe.
    """
    with _begun(order) as run:  # objects, meshes
        make_shards(run, runner, watch)  # scenes, renders, shards
        finished = run.publication.finish()
        run.require_within_budget()
        statistics = None
        if finished and not run.publication.left_to_others:
            statistics = runner.finish(lambda: make_documents(run.publication))
    return run.outcome(finished, statistics)


def prepare_dataset(order: DatasetOrder) -> Run:
    """Begin a dataset and freeze its objects, without a picture; raises as `make_dataset`."""
    with _begun(order) as run:
        return run


@contextlib.contextmanager
def _begun(order: DatasetOrder) -> Iterator[Run]:
    """Join the makers of a dataset, and have its objects frozen by whoever comes first."""
    folder = dataset_folder(order.place)
    folder = replace(folder, root=Path(os.path.realpath(folder.root)))
    settings, listed = settings_of(order, folder)  # refuses an order before anything is written
    with joined(folder):
        own = map_folders(order, settings)
        publication = begun_publication(order, settings, folder)
        if listed or order.revisits:
            with folder.turn("objects"):
                publication.refresh()
                accepted = (
                    accept_scene_files(listed, order.licence, settings, publication)
                    if listed
                    else accept_revisited(order.revisits or "", settings, publication)
                )
        else:
            accepted = _accept_together(order, settings, publication, own)
        write_asked(folder, generate_words(order))
        yield Run(
            order=order,
            settings=settings,
            listed=listed,
            publication=publication,
            accepted=accepted,
        )


def _accept_together(
    order: DatasetOrder, settings: BuildSettings, publication: Publication, own: MapFolders
) -> AcceptedObjects:
    """Return the frozen objects: at once where they are known, else prepared with other workers."""
    asked = AskedObjects(
        source=object_source(settings, order.objects),
        licence=order.licence,
        settings=settings,
        publication=publication,
        workers=cores_owned(),
        own=own,
    )
    if trusted := trusted_objects(asked):
        return trusted
    listed = share_mesh_work(asked)
    with publication.folder.turn("objects"):  # one maker freezes, and the others find it done
        publication.refresh()
        return accept_objects(asked, listed)


def make_shards(run: Run, runner: Runner, watch: Watcher) -> None:
    """Turn frozen meshes into shards: the runner runs many tasks at once, each by `make_task`."""
    publication = run.publication
    job = run.job(runner.num_at_once or run.num_workers())
    try:
        for this_round in rounds(run, at_once=runner.window or job.num_at_once):
            for outcome in runner.run(this_round.tasks, job):  # here work goes parallel
                this_round.record(outcome)
                for shard in outcome.shards:
                    publication.add_shard(shard)
                watch(run, outcome)
                run.require_within_budget()
    finally:
        close_children()


def make_task(job: ShardJob, pieces: tuple[Piece, ...]) -> TaskOutcome:
    """Make the scenes of some pieces, and the shards that are whole then.

    This is what a runner calls for each task, on a thread, in another process or on another
    machine. What is there already is not made again.

    Raises:
        TrilightError: the output cannot be written, or this machine would make other bytes.
    """
    started = time.monotonic()
    with render_child(job) as child, scene_reader(job) as read:
        made = [make_piece(job, piece, child, read) for piece in pieces]
    seconds = time.monotonic() - started
    return TaskOutcome(
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
    """Make what is missing of a piece, and pack its shard if that is whole then.

    Scenes that somebody else is making are left to them; whoever stages the last one packs. A scene
    that cannot be made is not an error: the shard goes without it, and failures.jsonl says why.

    Returns:
        How many scenes were made or given up here, and the shard where this call packed it.
    """
    splits, profile = job.settings.splits, job.settings.storage.profile
    shard, scenes = UnfinishedShard(job.folder, splits, piece.shard_index), 0
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
    """Turn meshes into a scene with pictures: the first attempt that is not rejected, if any is.

    In the child, `attempt_scene` composes the scene and renders its views; a scene of a file is
    read in another one, by `read`. If a child is killed, crashes or takes too long, the same
    attempt is tried again in a new one. An object whose prepared file is away is brought back by
    `restore`, for the same attempt.
    """
    failures: list[Failure] = []
    for attempt in range(attempts):
        key = sample_key(scene_index)
        try:
            found = (read(scene_index),) if read else ()
            tried = call_with_retries(child, attempt_scene, split, scene_index, attempt, *found)
            while tried.away:
                restore(*tried.away)
                tried = call_with_retries(child, attempt_scene, split, scene_index, attempt)
        except (ChildFailed, Rejected) as error:
            if isinstance(error, Rejected):
                stage, reason, why = "scenes", error.reason, error.message
            else:
                why = f"{error.reason}: {error.sentence}"
                stage, reason = "renders", "environmental_skip"
            failures.append(
                Failure(stage=stage, item=key, reason=reason, message=why, attempt=attempt)
            )
            continue
        failures += tried.failures
        if tried.sample:
            return tried.sample, failures
    return None, failures


def make_documents(publication: Publication) -> Statistics:
    """Turn all shards into documents; one maker at a time."""
    with publication.folder.turn("documents"):
        statistics = write_documents(publication.dataset(), publication.folder)
        publication.send_documents()
        return statistics
