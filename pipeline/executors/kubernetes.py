"""`--runner kubernetes`: makes the shards of one task of an indexed Job, on threads.

Kubernetes starts the same container with the index 0, 1, 2, ... in JOB_COMPLETION_INDEX, and again
with the same index when a task is lost. TASKS maps each index to a task, such as 0-3,7, so that
only missing shards are made; SHARDS_PER_TASK sets the shards of a task. No task waits for another:
they share the bucket, and the task that makes the last shard finishes the dataset. `trilight submit
kubernetes` makes such jobs (pipeline.executors.kubernetes_array). It has not run on a real cluster
yet; tests give tasks the variables that the manual documents.
"""

import dataclasses
import os
from collections.abc import Mapping

from pipeline.executors.threads import ThreadRunner
from pipeline.generation.dataset_order import DatasetOrder
from pipeline.generation.pipeline import make_dataset
from pipeline.generation.run import Outcome
from storage.errors import TrilightError
from storage.number_ranges import MOST_NUMBERS, numbers_of

PLACE = "JOB_COMPLETION_INDEX"
"""Variable with the index of a task in the Job, from 0."""


def make(order: DatasetOrder, address: str | None) -> Outcome:
    """Make the shards of this task.

    Raises:
        TrilightError: this is no task of an indexed Job, or the options have a range of shards; or
            as `make_dataset`.
    """
    if order.shards is not None:
        raise TrilightError(
            f"--shards is {order.shards}; expected none with --runner kubernetes: the place in "
            "the array says which shards are made. Omit one of the two."
        )
    shards = shards_of_place(os.environ)
    return make_dataset(dataclasses.replace(order, shards=shards), ThreadRunner())


def shards_of_place(environment: Mapping[str, str]) -> str:
    """Return the range A:B of shards of this task.

    Args:
        environment: variables that Kubernetes and the Job's manifest set.

    Raises:
        TrilightError: a variable is missing or malformed, or the index is beyond the tasks.
    """
    text = _text(environment, "TASKS")
    tasks = numbers_of(text)
    if not tasks:
        raise TrilightError(
            f"--runner kubernetes: TASKS is {text!r:.60}; expected numbers of tasks such as "
            f"0-3,7, at most {MOST_NUMBERS}."
        )
    each = _number(environment, "SHARDS_PER_TASK", least=1)
    place = _number(environment, PLACE, least=0)
    if place >= len(tasks):
        raise TrilightError(
            f"--runner kubernetes: {PLACE} is {place}; expected a place below {len(tasks)}, "
            "the number of tasks in TASKS. Submit the array as trilight submit made it."
        )
    return f"{tasks[place] * each}:{(tasks[place] + 1) * each}"


def _number(environment: Mapping[str, str], name: str, *, least: int) -> int:
    text = _text(environment, name)
    if not (text.isascii() and text.isdecimal()) or int(text) < least:
        raise TrilightError(
            f"--runner kubernetes: {name} is {text!r:.60}; expected a number from {least}."
        )
    return int(text)


def _text(environment: Mapping[str, str], name: str) -> str:
    if name not in environment:
        raise TrilightError(
            f"--runner kubernetes: {name} is not set; expected a task of an array, as trilight "
            "submit kubernetes makes it. Submit one, or choose another --runner."
        )
    return environment[name]
