"""Makers as real processes on a folder or a bucket, whose scenes take a set time and are not made.

Everything else is what a run does: begin, claims, staged scenes, shards, notes, publication. Makers
of a bucket have a cache each, as machines do.
"""

import dataclasses
import itertools
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from infra.bench.subjects.simulated_set import simulated_build
from infra.bench.subjects.stand_in import stand_in_objects, stand_in_sample
from pipeline.making.bucket_publication import begin_dataset, joined
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.freeze_objects import AcceptedObjects
from pipeline.making.pipeline import make_shards
from pipeline.making.publication import Publication
from pipeline.making.run import Run, ShardJob, TaskOutcome
from pipeline.making.tasks import Piece
from pipeline.making.unfinished_shard import UnfinishedShard
from storage.dataset.layout import dataset_folder
from storage.dataset.manifest import ShardEntry
from storage.dataset.statistics import Statistics
from storage.records.sample import sample_key

_PATIENCE_S = 600.0
_LATE = ("webdataset.writer", "OpenEXR", "s3fs")
"""Modules that are imported when they are first needed, which would count as work."""


@dataclass(frozen=True, kw_only=True)
class Stint:
    """What one maker does."""

    place: str
    """The dataset: a folder, or the URL of a bucket."""
    cache: str
    """Folder of the maker's machine."""
    shards: tuple[int, int]
    """The first of its shards, and one beyond the last."""
    num_shards: int
    """Shards of the dataset."""
    scenes_per_shard: int
    """Scenes of each."""
    scene_s: float
    """What a scene takes, waiting."""
    environment: Mapping[str, Any]
    """What the machine has, looked for once: 64 probes at a time on few cores run out of time."""


@dataclass(frozen=True, kw_only=True)
class StintTimes:
    """How long a maker was at what."""

    begin_s: float
    """On the clock, until its first scene."""
    begin_core_s: float
    """Core-seconds of that."""
    made_s: float
    """On the clock, until its last shard was noted."""
    made_core_s: float
    """Core-seconds of that."""
    end_s: float
    """On the clock, at the end."""
    end_core_s: float
    """Core-seconds of that."""


class StandIns:
    """A runner whose scenes take a set time; in this process, one at a time."""

    num_at_once = 1
    window = None

    def __init__(self, scene_s: float) -> None:
        self._scene_s = scene_s
        self._sample = stand_in_sample(0)

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskOutcome]:
        """Yield what became of each task."""
        for task in tasks:
            began = time.monotonic()
            made = [self._piece(job, piece) for piece in task]
            seconds = time.monotonic() - began
            yield TaskOutcome(
                shards=tuple(shard for _, shard in made if shard),
                scenes=sum(scenes for scenes, _ in made),
                seconds=seconds,
                core_s=seconds,
            )

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call what writes the documents."""
        return write_documents()

    def _piece(self, job: ShardJob, piece: Piece) -> tuple[int, ShardEntry | None]:
        splits, scenes = job.settings.splits, 0
        shard = UnfinishedShard(job.folder, splits, piece.shard_index)
        for index in range(piece.first, piece.last):
            with shard.claim(index) as ours:
                if not ours:
                    continue
                began = time.monotonic()
                time.sleep(self._scene_s)
                sample = dataclasses.replace(self._sample, key=sample_key(index))
                profile = job.settings.storage.profile
                shard.stage(index, sample, [], profile, began=began, cores=1)
                scenes += 1
        return scenes, shard.pack()


def begun_here(stint: Stint, *, freeze: bool) -> None:
    """Begin the dataset of a stint, and freeze its objects."""
    os.environ["TRILIGHT_CACHE"] = stint.cache
    with joined(dataset_folder(stint.place)):
        publication = _begun(stint)
        if freeze:
            publication.lock_objects(stand_in_objects())


def _begun(stint: Stint) -> Publication:
    return begin_dataset(
        dataset_folder(stint.place),
        simulated_build(stint.scenes_per_shard),
        stint.environment,
        stint.num_shards * stint.scenes_per_shard,
        accept_environment=False,
    )


def one_stint(stint: Stint) -> StintTimes:
    """Make the shards of a stint, as `make_dataset` does from `begin` to the last look."""
    os.environ["TRILIGHT_CACHE"] = stint.cache
    times = [_now()]
    order = DatasetOrder(
        build="smoke",
        out=stint.place,
        shards="{}:{}".format(*stint.shards),
        scenes=stint.num_shards * stint.scenes_per_shard,
    )
    with joined(dataset_folder(stint.place)):
        publication = _begun(stint)
        publication.refresh()
        run = Run(
            order=order,
            settings=simulated_build(stint.scenes_per_shard),
            listed=None,
            publication=publication,
            accepted=AcceptedObjects(num_objects=0, num_found=0),
        )
        times.append(_now())
        make_shards(run, StandIns(stint.scene_s), lambda run, outcome: None)
        times.append(_now())
        publication.finish()
    times.append(_now())
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(times)]
    (begin, begin_core), (made, made_core), (end, end_core) = steps
    return StintTimes(
        begin_s=begin, begin_core_s=begin_core, made_s=made, made_core_s=made_core,
        end_s=end, end_core_s=end_core,
    )  # fmt: skip


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def stints_together(stints: list[Stint]) -> tuple[float, list[StintTimes]]:
    """Run each stint in a process of its own, all at the same time.

    Processes are forked from one that has imported everything, so that they share its memory, and
    begin together.

    Returns:
        Seconds on the clock until the last one ended, and what each took.

    Raises:
        RuntimeError: one of them ended without a result.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, *_LATE])
    started = []
    for stint in stints:
        ours, theirs = context.Pipe()
        given = (theirs, stint, dict(os.environ))
        process = context.Process(target=_in_process, args=given, daemon=True)
        process.start()
        theirs.close()
        started.append((process, ours))
    for _, ours in started:
        ours.recv()  # it is ready
    began = time.perf_counter()
    for _, ours in started:
        ours.send(None)
    found = [_result(ours) for _, ours in started]
    seconds = time.perf_counter() - began
    for process, _ in started:
        process.join()
    return seconds, found


def _result(connection: Connection) -> StintTimes:
    if not connection.poll(_PATIENCE_S):
        raise RuntimeError(f"a maker has not ended after {_PATIENCE_S:.0f} s")
    try:
        found = connection.recv()
    except EOFError as error:
        raise RuntimeError("a maker ended without a result; see above") from error
    assert isinstance(found, StintTimes)
    return found


def _in_process(connection: Connection, stint: Stint, environ: dict[str, str]) -> None:
    os.environ.update(environ)  # the process that this is forked from has an earlier one
    stand_in_sample(0)
    Path(stint.cache).mkdir(parents=True, exist_ok=True)
    connection.send(None)
    connection.recv()
    connection.send(one_stint(stint))
