"""`--runner kubernetes`, `aws-batch`, `google-batch` and `sky`: one task of an array, on threads.

Such a scheduler starts the same container with the places 0, 1, 2, ... in a variable of its own
(pipeline.executors.registry), and again with the same place when a task is lost. TASKS says which
task each place has, such as 0-3,7, so that only what is missing is made; SHARDS_PER_TASK says how
many shards a task makes. No task waits for another: they meet in the bucket, and whoever makes the
last shard finishes the dataset. `trilight submit` makes such arrays. Nobody has run one on a real
cloud yet; tests give tasks the variables that the manuals promise.
"""

import dataclasses
import os
from collections.abc import Mapping

from pipeline.executors.registry import INDEX_VARIABLES
from pipeline.executors.threads import ThreadRunner
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.pipeline import make_dataset
from pipeline.making.run import Outcome
from storage.errors import TrilightError
from storage.number_ranges import MOST_NUMBERS, numbers_of


def make(order: DatasetOrder, address: str | None, scheduler: str) -> Outcome:
    """Make the shards of this task.

    Raises:
        TrilightError: this is no task of an array of that scheduler, or the order has a range of
            its own; or as `make_dataset`.
    """
    if order.shards is not None:
        raise TrilightError(
            f"--shards is {order.shards}; expected none with --runner {scheduler}: the place in "
            "the array says which shards are made. Omit one of the two."
        )
    shards = shards_of_place(os.environ, scheduler)
    return make_dataset(dataclasses.replace(order, shards=shards), ThreadRunner())


def shards_of_place(environment: Mapping[str, str], scheduler: str) -> str:
    """Return the range A:B of shards that falls to this task.

    An array of one task needs no place: AWS Batch knows none of a single job.

    Args:
        environment: what the scheduler and the array's description set.
        scheduler: one of INDEX_VARIABLES.

    Raises:
        TrilightError: a variable is missing or malformed, or the place is beyond the tasks.
    """
    tasks = _tasks(environment, scheduler)
    each = _number(environment, "SHARDS_PER_TASK", scheduler, least=1)
    variable = INDEX_VARIABLES[scheduler]
    alone = len(tasks) == 1 and variable not in environment
    place = 0 if alone else _number(environment, variable, scheduler, least=0)
    if place >= len(tasks):
        raise TrilightError(
            f"--runner {scheduler}: {variable} is {place}; expected a place below {len(tasks)}, "
            "the number of tasks in TASKS. Submit the array as trilight submit made it."
        )
    return f"{tasks[place] * each}:{(tasks[place] + 1) * each}"


def _tasks(environment: Mapping[str, str], scheduler: str) -> list[int]:
    text = _text(environment, "TASKS", scheduler)
    if not (numbers := numbers_of(text)):
        raise TrilightError(
            f"--runner {scheduler}: TASKS is {text!r:.60}; expected numbers of tasks such as "
            f"0-3,7, at most {MOST_NUMBERS}."
        )
    return numbers


def _number(environment: Mapping[str, str], name: str, scheduler: str, *, least: int) -> int:
    text = _text(environment, name, scheduler)
    if not (text.isascii() and text.isdecimal()) or int(text) < least:
        raise TrilightError(
            f"--runner {scheduler}: {name} is {text!r:.60}; expected a number from {least}."
        )
    return int(text)


def _text(environment: Mapping[str, str], name: str, scheduler: str) -> str:
    if name not in environment:
        raise TrilightError(
            f"--runner {scheduler}: {name} is not set; expected a task of an array, as trilight "
            f"submit {scheduler} makes it. Submit one, or choose another --runner."
        )
    return environment[name]
