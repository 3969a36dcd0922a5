"""`Run` and other records that the steps of `pipeline.generation.pipeline` pass to each other.

`TaskCutter` cuts the missing scenes into tasks, in rounds until nothing is missing. A piece is a
range of scenes of one shard; a task is several pieces. Small shards are combined, large ones are
cut. A task takes one to ten minutes, and a run has at most a thousand of them. How long a scene
takes is known only as the run goes, so each task is cut when it is submitted.

Several workers may share a dataset. A round skips the scenes that others have claimed; after it, a
run waits until they are done, and makes the scenes that a killed worker left.

`Runner` is the interface between the engine and the executors that run its tasks. The engine
imports no executor: threads and arrays are in pipeline.executors, Prefect and Dask in
pipeline.flows, and a user may add another. A runner takes tasks one by one as it has room, and
yields their results as they end: memory does not grow with the number of tasks, and no finished
task waits for a slow one.
"""

import contextlib
import itertools
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Generic, TypeVar

from pipeline.exchange.scene_files import SceneFiles, find_scene_files
from pipeline.generation.dataset_writer import DatasetWriter, begin_or_resume_dataset
from pipeline.generation.freeze_objects import ObjectLock
from pipeline.generation.generate_options import GenerateOptions, generate_words
from pipeline.generation.scene_origins import (
    Accept,
    AcceptedObjects,
    accept_scene_files,
    resolve_revisit,
    settings_for_files,
)
from pipeline.objects.sources import check_source
from pipeline.presets.registry import DATASET_PRESETS, frozen_note
from pipeline.presets.settings import DatasetSettings
from pipeline.renders.mitsuba_variant import (
    Device,
    Variant,
    choose_variant,
    device_of,
    environment,
    gpu_memory_bytes,
    visible_gpus,
)
from pipeline.shards.pack_shards import PublishedShards, UnfinishedShard
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, read_head
from storage.dataset.progress import write_asked
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import keeps_scenes, lacks_validation, scenes_of_shard
from storage.dataset.statistics import Statistics
from storage.errors import EnvironmentFailure, TrilightError
from storage.file_locks import WaitNotice
from storage.records.objects import Failure

_MOST_CHILDREN = 4
"""Children of a GPU. One that only renders fills an H200 (60,700 views an hour, four 58,500), but a
child also composes, checks and encodes on the CPU meanwhile."""

_CHILD_BYTES = 1 << 30
"""GPU memory of a render child; four used 4.6 GB in all on an H200."""

_PIXEL_BYTES = 2400
"""More of it for each pixel: a pass of 64 samples, which Dr.Jit rounds up to powers of two."""

_USED = 0.9
"""Fraction of a GPU's memory that render children may fill."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """A dataset that has begun, with its objects frozen: the input of every later step."""

    options: GenerateOptions
    publication: DatasetWriter
    """Writes the manifest and publishes finished shards."""
    job: "ShardJob"
    """Input that all tasks of the run share."""

    def unfinished_shards(self) -> list[int]:
        return self.publication.unfinished_shards(self.options.shard_range())

    def outcome(self, finished: Manifest | None, statistics: Statistics | None) -> "Outcome":
        """Return the result of the run; a finished dataset adds its digest and statistics."""
        writer = self.publication
        notes: tuple[str, ...] = ()
        origin = self.job.accepted.origin
        if isinstance(origin, SceneFiles):
            notes = origin.notes
        elif statistics and self.options.revisits is None:
            splits = self.job.settings.splits
            num_scenes = writer.manifest.num_scenes
            kept_note = keeps_scenes(num_scenes, self.options.scenes, splits)
            size_notes = filter(None, (kept_note, lacks_validation(num_scenes, splits)))
            notes = (*frozen_note(self.options.build, statistics), *size_notes)
        return Outcome(
            digest=finished.dataset_digest if finished else "",
            num_objects_found=self.job.accepted.num_found,
            num_objects_used=self.job.accepted.num_objects,
            num_scenes_given_up=writer.given_up,
            failures=tuple(writer.failures),
            num_shards=len(finished.shards) if finished else writer.num_finished_shards(),
            num_shards_planned=writer.num_shards,
            statistics=statistics,
            notes=notes,
        )

    def require_within_budget(self) -> None:
        """Raise TrilightError if too many scenes failed: in this run, at the end in all runs.

        Scene files that cannot become a scene do not count.
        """
        writer = self.publication
        origin = self.job.accepted.origin
        num_unusable = len(origin.unusable) if isinstance(origin, SceneFiles) else 0
        num_scenes = writer.manifest.num_scenes
        budget = self.options.failure_budget
        given_up = writer.given_up
        if given_up > budget * num_scenes + num_unusable:
            writer.add_failures(writer.failures)
            raise TrilightError(
                f"{writer.folder.display_name}: {given_up} of {num_scenes} scenes could not be "
                f"made, more than the failure budget of {budget:.0%}. The reasons are in "
                f"{writer.folder.failures.name}; fix them, or raise --failure-budget."
            )


def default_workers(device: Device, resolution: int) -> int:
    """Return the usual number of parallel tasks of one process; an executor may set another."""
    if device == "cpu":
        return 1
    return max(1, len(visible_gpus())) * children_of_gpu(resolution, gpu_memory_bytes())


def children_of_gpu(resolution: int, memory_bytes: int) -> int:
    """Return how many render children keep a GPU busy and fit into its memory.

    Args:
        resolution: of their pictures, in pixels.
        memory_bytes: of the GPU.
    """
    child_bytes = _CHILD_BYTES + _PIXEL_BYTES * resolution**2
    return min(_MOST_CHILDREN, max(1, int(_USED * memory_bytes) // child_bytes))


@dataclass(frozen=True, kw_only=True, eq=False)
class ShardJob:
    """The input that all tasks of a run share; it can be sent to another machine."""

    folder: DatasetFolder
    """The dataset, at the same path on every machine."""
    settings: DatasetSettings
    """Settings of the dataset, with all changes applied."""
    environment: Mapping[str, Any]
    """Environment of the dataset's first run, required of every worker; empty to accept any."""
    accepted: AcceptedObjects
    """The frozen objects; a prepared file that is missing in the user's cache is made again."""
    lock_sha256: str
    """Digest of the frozen objects."""
    num_at_once: int
    """Tasks at a time in one process; they share its cores."""
    extensions: Mapping[str, str]
    """Extensions of the dataset's first run, required of every worker (storage.extensions)."""
    device: Device = "cpu"
    """Device that renders on every worker, `cpu` or `gpu`."""


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """The result of one task."""

    shards: tuple[ShardEntry, ...]
    scenes: int
    """Scenes that the task made or gave up, without those that were finished before."""
    seconds: float
    core_s: float
    """Wall time multiplied by the cores of the render child."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """The result of a run."""

    digest: str
    """The dataset digest; empty where the dataset is not finished."""
    num_objects_found: int
    """Objects in the source, or the files that scenes are made of."""
    num_objects_used: int
    """Objects that scenes may draw from."""
    num_scenes_given_up: int
    """Scenes whose every attempt failed; only those of this run while the dataset is unfinished."""
    failures: tuple[Failure, ...]
    """Rejections of this run that are not in `failures.jsonl` yet."""
    num_shards: int
    """Finished shards, as far as this machine knows."""
    num_shards_planned: int
    """Shards of the finished dataset."""
    statistics: Statistics | None
    """Statistics of the dataset; None if it is unfinished, or another machine writes the
    documents."""
    notes: tuple[str, ...] = ()
    """Notes for the user: unknown fields of scene files, unused cameras, and whether a frozen set
    is the published one."""


Watcher = Callable[[Run, TaskResult], None]
"""Called after each task."""


def resolve_inputs(
    options: GenerateOptions, folder: DatasetFolder
) -> tuple[DatasetSettings, Accept]:
    """Return the dataset's settings, and what freezes the objects or files of its scenes.

    Raises:
        TrilightError: the settings contradict each other, or the source or files are unusable.
    """
    settings = options.settings
    if options.revisits is not None or settings.revisit is not None:
        return resolve_revisit(settings, options.revisits)
    licence = options.licence
    # of scene files too: they draw no maps, so that shares of maps are refused
    maps = options.map_folders()
    if options.scenes_from is not None:
        files = find_scene_files(options.scenes_from, options.albedo_over_one)
        settings = settings_for_files(settings, files, options.views)
        return settings, partial(accept_scene_files, files, licence, settings)
    source = options.source
    if not folder.manifest.exists():
        check_source(source, allowed_licences=settings.allowed_licences, licence=licence)

    def accept(writer: DatasetWriter) -> AcceptedObjects:
        return ObjectLock(
            source=source,
            licence=licence,
            settings=settings,
            writer=writer,
            map_folders=maps,
            map_licence=options.map_licence,
        ).accept()

    return settings, accept


def choose_dataset_variant(options: GenerateOptions, folder: DatasetFolder) -> Variant:
    """Return the variant that renders a dataset.

    It is that of the device which the dataset was begun on, unless the options or TRILIGHT_VARIANT
    name another one. A new dataset takes its preset's device. Raises as `choose_variant`.
    """
    default = DATASET_PRESETS[options.build].device
    device = options.device
    if folder.manifest.exists():
        default = device_of(read_head(folder.manifest).environment)
        device = default if device == "auto" else device
    return choose_variant(default, device=device)


@contextlib.contextmanager
def begin_run(options: GenerateOptions) -> Iterator[Run]:
    """Join a dataset's workers and yield the run; the first worker freezes the objects."""
    folder = options.folder
    folder = replace(folder, root=Path(os.path.realpath(folder.root)))
    settings, accept = resolve_inputs(options, folder)  # refuses before anything is written
    shards = PublishedShards(folder)
    with shards.hold_lock():
        variant = choose_dataset_variant(options, folder)
        writer = begin_or_resume_dataset(
            shards,
            settings,
            environment(variant),
            options.num_scenes,
            accept_environment=options.accept_environment,
        )
        requested = options.shard_range()
        if requested is not None and requested.start >= writer.num_shards:
            raise TrilightError(
                f"--range is {options.shards!r}; expected one that begins below "
                f"{writer.num_shards}, the shards of {writer.manifest.num_scenes} scenes."
            )
        if not writer.manifest.objects_lock_sha256:  # else other objects may be refused yet
            _write_command(options, settings, writer)
        accepted = accept(writer)
        _write_command(options, settings, writer)
        manifest = writer.manifest
        job = ShardJob(
            folder=folder,
            settings=settings,
            environment={} if options.accept_environment else manifest.environment,
            accepted=accepted,
            lock_sha256=manifest.objects_lock_sha256,
            num_at_once=options.workers
            or default_workers(variant.device, settings.renders.resolution),
            extensions=manifest.extensions,
            device=variant.device,
        )
        yield Run(options=options, publication=writer, job=job)


def _write_command(
    options: GenerateOptions, settings: DatasetSettings, writer: DatasetWriter
) -> None:
    """Write down the command that makes the dataset, with the scenes that it keeps."""
    num_scenes = writer.manifest.num_scenes
    if keeps_scenes(num_scenes, options.scenes, settings.splits):
        options = replace(options, scenes=num_scenes)
    write_asked(writer.folder, generate_words(options))


MAX_TASKS = 1000
"""Most task runs of one flow run: Prefect's server accepts about 20 a second, of 19 kB each."""
TASK_S = 240.0
"""Target duration of a task, in seconds."""
_FIRST_SCENES = 4
"""Scenes of a task until the duration of one has been measured."""
FIRST_PAUSE_S = 1.0
_LONGEST_PAUSE_S = 60.0
"""Most seconds between two looks at other workers' scenes; the pause doubles while none is free."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """A range of scenes of one shard, which a task makes one after another."""

    shard_index: int
    """Number of the shard, from 0."""
    first: int
    """Index of the first scene in the dataset."""
    last: int
    """Index of the last scene plus 1."""


class TaskCutter:
    """Cuts missing scenes into tasks, sized by the durations of finished ones."""

    def __init__(self, at_once: int = 1) -> None:
        """Begin; `at_once` is the number of tasks that run at the same time."""
        self._at_once = at_once
        self._tasks_left = MAX_TASKS
        self._scenes = 0
        self._seconds = 0.0

    def record(self, outcome: TaskResult) -> None:
        """Record the duration of a finished task."""
        if outcome.scenes:
            self._scenes += outcome.scenes
            self._seconds += outcome.seconds

    def cut_round(
        self, shards: Sequence[int], splits: SplitSettings
    ) -> Iterator[tuple[Piece, ...]]:
        """Yield the tasks that make some shards, but save a tenth of the tasks for later rounds.

        Each is sized when it is requested.

        Raises:
            EnvironmentFailure: no task is left of the maximum over all rounds.
        """
        if self._tasks_left == 0:
            raise EnvironmentFailure(
                f"this run has handed out all of its {MAX_TASKS} tasks, and other runs hold "
                "claims on the missing scenes. What was finished is safe: run the same command "
                "again."
            )
        most = self._tasks_left - self._tasks_left // 10
        scenes_left = sum(len(scenes_of_shard(index, splits)) for index in shards)
        scenes = ((index, scene) for index in shards for scene in scenes_of_shard(index, splits))
        while task := list(itertools.islice(scenes, self._next_size(scenes_left, most))):
            most -= 1
            self._tasks_left -= 1
            scenes_left -= len(task)
            of_shards = itertools.groupby(task, key=itemgetter(0))
            rows = ((index, [scene for _, scene in group]) for index, group in of_shards)
            yield tuple(
                Piece(shard_index=index, first=row[0], last=row[-1] + 1) for index, row in rows
            )

    def _next_size(self, scenes_left: int, tasks_left: int) -> int:
        """Return the number of scenes of the next task, at least 1.

        With several tasks at once, none gets more than half of an equal share of the remaining
        scenes, so that all workers have work until the end (guided self-scheduling,
        Polychronopoulos and Kuck 1987).
        """
        size: float = _FIRST_SCENES
        if self._scenes:
            size = TASK_S * self._scenes / max(self._seconds, 1e-3)
        if self._at_once > 1:
            size = min(size, scenes_left / (2 * self._at_once))
        return max(1, int(size), -(-scenes_left // max(1, tasks_left)))


def wait_for_others(run: Run, pause_s: float) -> float:
    """Wait until nothing is missing or a claim is free; return the next pause in seconds.

    No tasks are submitted meanwhile: each would be a row of a scheduler's database.
    """
    writer = run.publication
    notice = WaitNotice()
    while True:
        time.sleep(pause_s)
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        missing = run.unfinished_shards()
        splits = run.job.settings.splits
        shards = [UnfinishedShard(writer.folder, splits, index) for index in missing]
        if not missing or any(shard.is_free() for shard in shards):
            return pause_s
        notice.update(shards[0].missing_claims()[0])


def shard_ranges(num_shards: int, num_ranges: int) -> list[str]:
    """Return `num_ranges` nearly equal ranges A:B of shards; fewer if there are fewer shards."""
    count = min(num_ranges, num_shards)
    bounds = [num_shards * index // count for index in range(count + 1)]
    return [f"{first}:{last}" for first, last in itertools.pairwise(bounds)]


Future = TypeVar("Future", bound=Any)
"""Has `result`, which returns the result of an ended task, or raises its error."""


class Runner(ABC, Generic[Future]):
    """Runs `pipeline.generation.pipeline.make_task` once for each task, on any machine."""

    num_at_once: int | None = None
    """Parallel tasks of one process; None leaves the number to the options."""
    window: int | None = None
    """Number of submitted, unfinished tasks; None means as many as run at once."""

    @abstractmethod
    def submit(self, task: tuple[Piece, ...], job: ShardJob) -> Future:
        """Start a task, and return its future at once."""

    @abstractmethod
    def wait_any(self, running: list[Future]) -> Future:
        """Wait until one of these tasks has ended, and return it."""

    def close(self) -> None:
        """Release what submitted tasks hold, also after an error."""

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskResult]:
        """Yield the result of each task, in the order in which the tasks end.

        The next task is submitted before a result is yielded: the caller may take long over it.

        Raises:
            TrilightError: a task failed permanently; finished scenes stay on disk.
        """
        waiting = iter(tasks)
        window = self.window or job.num_at_once
        try:
            running = [self.submit(task, job) for task in itertools.islice(waiting, window)]
            while running:
                done = self.wait_any(running)
                running.remove(done)
                result = done.result()
                free = window - len(running)
                running += [self.submit(task, job) for task in itertools.islice(waiting, free)]
                yield result
        finally:
            self.close()

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call `write_documents`; an executor may limit its parallel calls, which read all data."""
        return write_documents()
