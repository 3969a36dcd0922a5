"""`DatasetByArray`: a dataset, and the array that makes it, as a form of Prefect asks for both."""

from dataclasses import fields
from typing import Annotated, Literal

from pipeline.making.dataset_order import DatasetOrder
from storage.settings.described import checked
from storage.settings.ranges import Within

Scheduler = Literal["slurm", "kubernetes", "sky", "aws-batch", "google-batch", "none"]


@checked()
class DatasetByArray(DatasetOrder):
    """A dataset made by the tasks of a scheduler's array."""

    scheduler: Scheduler = "slurm"
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
            **{each.name: getattr(self, each.name) for each in fields(DatasetOrder)}
        )
