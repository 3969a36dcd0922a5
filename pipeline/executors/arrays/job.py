"""What is missing of a dataset as an array of tasks, of which every scheduler's form is made.

Task K makes `per_task` shards from K times that number on, so that a task means the same whenever
it is submitted, and what is missing can be submitted alone. Slurm names tasks by these numbers;
schedulers that count from 0 are given the numbers as TASKS (pipeline.executors.array_task).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.builds.named import BUILDS, named_build
from pipeline.making.dataset_order import DatasetOrder, generate_words
from storage.dataset.dataset import dataset_files
from storage.dataset.layout import dataset_folder
from storage.dataset.progress import missing_shards
from storage.dataset.splits import shards_for
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from storage.remote.safe_url import safe_url
from storage.settings.changes import changed

MOST_TASKS = 1000
"""Of one array: a Slurm cluster whose MaxArraySize is not changed refuses task 1001, and clouds
refuse long environments."""


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

    def words(self, runner: str) -> list[str]:
        """Return the command of each task, `trilight` first."""
        words = generate_words(self.order)
        return ["trilight", *words, "--out", self.order.place, "--runner", runner]

    @property
    def environment(self) -> Mapping[str, str]:
        """What a task reads where its scheduler counts from 0."""
        return {"SHARDS_PER_TASK": str(self.per_task), "TASKS": number_ranges(self.tasks)}


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
    missing = missing_shards(order.place) if _is_begun(order.place) else list(range(planned))
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
