"""What is missing of a dataset as an array of tasks, for Slurm and for Kubernetes.

Task K makes `per_task` shards from K times that number on, so that a task means the same whenever
it is submitted, and what is missing can be submitted alone. Slurm names tasks by these numbers;
Kubernetes counts from 0, and is given the numbers as TASKS (pipeline.executors.kubernetes).
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pipeline.builds.named import BUILDS, named_build
from pipeline.making.dataset_order import DatasetOrder
from storage.dataset.dataset import dataset_files
from storage.dataset.layout import dataset_folder
from storage.dataset.progress import missing_shards
from storage.dataset.splits import shards_for
from storage.errors import TrilightError
from storage.remote.safe_url import safe_url
from storage.settings.changes import changed
from storage.settings.described import checked
from storage.settings.ranges import Within

MOST_TASKS = 1000
"""Of one array: a Slurm cluster whose MaxArraySize is not changed refuses task 1001."""


@checked()
class DatasetByArray(DatasetOrder):
    """A dataset made by the tasks of a scheduler's array."""

    scheduler: Literal["slurm", "kubernetes", "none"] = "slurm"
    """Scheduler that is asked for what is missing; none only watches what others have submitted."""
    shards_per_task: Annotated[int | None, Within(1, 10**6, unit="shards")] = None
    """Number of shards of an array task; by default as few as 1000 tasks allow."""
    at_once: Annotated[int | None, Within(1, 10**6, unit="tasks")] = None
    """Maximum number of tasks that run at the same time; by default the scheduler decides."""
    quiet_hours: Annotated[float, Within(0.0001, 1000.0, unit="hours")] = 6.0
    """Longest time without a new scene in hours, waiting in the queue included, after which the run
    fails; the array is left as it is."""

    @property
    def dataset(self) -> DatasetOrder:
        """The dataset alone, as the tasks are asked for it."""
        return DatasetOrder(
            **{each.name: getattr(self, each.name) for each in dataclasses.fields(DatasetOrder)}
        )


@dataclass(frozen=True, kw_only=True)
class ArrayJob:
    """One submission."""

    order: DatasetOrder
    """The dataset, with its number of scenes."""
    tasks: Sequence[int]
    """Numbers of the tasks that have something to make; none where nothing is missing."""
    per_task: int
    """Shards of a task."""
    at_once: int | None
    """Most tasks that run at the same time; None for as many as the scheduler lets."""


def array_job(
    order: DatasetOrder, *, per_task: int | None, at_once: int | None, on: str = "slurm"
) -> ArrayJob:
    """Return the array that makes what is missing of a dataset, which need not be begun.

    Args:
        order: the dataset.
        per_task: shards of a task; by default as few as an array has tasks for.
        at_once: most tasks at the same time.
        on: the scheduler, for messages.

    Raises:
        TrilightError: the order is of scene files or of a part, names a password, its dataset
            cannot be read, or the array would have too many tasks.
    """
    if order.scenes_from or order.revisits or order.shards:
        raise TrilightError(
            f"submit {on}: expected no --scenes-from, --revisits or --shards: the array divides "
            "scenes that are composed. Start such a dataset by trilight generate on each machine."
        )
    if order.objects and safe_url(order.objects) != order.objects and "://" in order.objects:
        raise TrilightError(
            f"submit {on}: --objects {safe_url(order.objects)} holds a password, which every user "
            "of the cluster could read in the queue; expected env:TRILIGHT_SOURCE_NAME, with the "
            "address in that variable of the tasks."
        )
    scenes = order.scenes or BUILDS.find(order.build).num_scenes
    splits = changed(named_build(order.build), order.changes).splits
    planned = shards_for(scenes, splits)
    begun = _is_begun(order.place)
    missing = missing_shards(order.place, scenes) if begun else list(range(planned))
    each = per_task or -(-planned // MOST_TASKS)
    tasks = sorted({shard // each for shard in missing})
    if tasks and tasks[-1] >= MOST_TASKS:
        raise TrilightError(
            f"--shards-per-task is {each}: the array would end with task {tasks[-1]}; expected at "
            f"most {MOST_TASKS - 1}, which schedulers allow by default. {-(-planned // MOST_TASKS)}"
            " shards a task fit."
        )
    order = dataclasses.replace(order, scenes=scenes, out=order.place, workers=None)
    return ArrayJob(order=order, tasks=tasks, per_task=each, at_once=at_once)


def _is_begun(place: str) -> bool:
    """Return whether a folder or bucket holds a dataset's manifest."""
    folder = dataset_folder(place)
    if not folder.bucket:
        return folder.manifest.exists()
    found = dataset_files(place).open_beside(folder.manifest.name)
    if found is None:
        return False
    found.close()
    return True
