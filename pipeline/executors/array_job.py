"""Divides the missing shards of a dataset into an array of tasks, for Slurm and for Kubernetes.

Task K makes `per_task` shards from shard K * `per_task` on, so that a task means the same whenever
it is submitted, and missing tasks can be submitted alone. Slurm numbers tasks so; Kubernetes counts
from 0, and gets these numbers as TASKS (pipeline.executors.kubernetes).
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pipeline.generation.generate_options import GenerateOptions
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from storage.dataset.dataset import dataset_files
from storage.dataset.layout import dataset_folder
from storage.dataset.progress import missing_shards
from storage.dataset.splits import shards_for
from storage.errors import TrilightError
from storage.remote.safe_url import safe_url
from storage.settings.described import checked
from storage.settings.overrides import apply_overrides
from storage.settings.ranges import Within

MAX_TASKS = 1000
"""Most tasks of one array: a Slurm cluster with the default MaxArraySize refuses task 1001."""


@checked()
class DatasetByArray(GenerateOptions):
    """A dataset made by the tasks of a scheduler's array."""

    scheduler: Literal["slurm", "kubernetes", "none"] = "slurm"
    """Scheduler that gets the missing tasks; none only shows the progress of submitted ones."""
    shards_per_task: Annotated[int | None, Within(1, 10**6, unit="shards")] = None
    """Number of shards of an array task; by default as few as 1000 tasks allow."""
    at_once: Annotated[int | None, Within(1, 10**6, unit="tasks")] = None
    """Maximum number of tasks that run at the same time; by default the scheduler decides."""
    quiet_hours: Annotated[float, Within(0.0001, 1000.0, unit="hours")] = 6.0
    """Longest time without a new scene in hours, waiting in the queue included, after which the run
    fails; the array is left as it is."""

    @property
    def dataset(self) -> GenerateOptions:
        """The options of the dataset alone, without those of the array."""
        return GenerateOptions(
            **{each.name: getattr(self, each.name) for each in dataclasses.fields(GenerateOptions)}
        )


@dataclass(frozen=True, kw_only=True)
class ArrayJob:
    """One submission of an array."""

    options: GenerateOptions
    """Options of the dataset, with its number of scenes."""
    tasks: Sequence[int]
    """Numbers of the tasks with missing shards; empty if nothing is missing."""
    per_task: int
    """Number of shards of a task."""
    at_once: int | None
    """Most tasks that run at the same time; None leaves it to the scheduler."""


def array_job(
    options: GenerateOptions, *, per_task: int | None, at_once: int | None, on: str = "slurm"
) -> ArrayJob:
    """Return the array that makes the missing shards of a dataset, which need not exist yet.

    Args:
        options: options of the dataset.
        per_task: shards of a task; by default as few as MOST_TASKS tasks allow.
        at_once: most tasks that run at the same time.
        on: name of the scheduler, for messages.

    Raises:
        TrilightError: the options name scene files, a range of shards or a password, the dataset
            cannot be read, or the array would have too many tasks.
    """
    if options.scenes_from or options.revisits or options.shards:
        raise TrilightError(
            f"submit {on}: expected no --scenes-from, --revisits or --shards: the array divides "
            "scenes that are composed. Start such a dataset by trilight generate on each machine."
        )
    if (
        options.objects
        and safe_url(options.objects) != options.objects
        and "://" in options.objects
    ):
        raise TrilightError(
            f"submit {on}: --objects {safe_url(options.objects)} holds a password, which every "
            "user of the cluster could read in the queue; expected env:TRILIGHT_SOURCE_NAME, with "
            "the address in that variable of the tasks."
        )
    scenes = options.scenes or DATASET_PRESETS.find(options.build).num_scenes
    splits = apply_overrides(preset_settings(options.build), options.changes).splits
    planned = shards_for(scenes, splits)
    is_begun = _is_begun(options.place)
    missing = missing_shards(options.place, scenes) if is_begun else list(range(planned))
    each = per_task or -(-planned // MAX_TASKS)
    tasks = sorted({shard // each for shard in missing})
    if tasks and tasks[-1] >= MAX_TASKS:
        raise TrilightError(
            f"--shards-per-task is {each}: the array would end with task {tasks[-1]}; expected at "
            f"most {MAX_TASKS - 1}, which schedulers allow by default. {-(-planned // MAX_TASKS)}"
            " shards a task fit."
        )
    options = dataclasses.replace(options, scenes=scenes, out=options.place, workers=None)
    return ArrayJob(options=options, tasks=tasks, per_task=each, at_once=at_once)


def _is_begun(location: str) -> bool:
    """Return True if a folder or bucket holds a dataset's manifest."""
    folder = dataset_folder(location)
    if not folder.bucket:
        return folder.manifest.exists()
    stream = dataset_files(location).open_beside(folder.manifest.name)
    if stream is None:
        return False
    stream.close()
    return True
