"""`--runner kubernetes`: makes the shards of one task of an indexed Job, on threads.

Kubernetes starts the same container with the index 0, 1, 2, ... in JOB_COMPLETION_INDEX, and again
with the same index when a task is lost. TASKS maps each index to a task, such as 0-3,7, so that
only missing shards are made; SHARDS_PER_TASK sets the shards of a task. No task waits for another:
they share the bucket, and the task that makes the last shard finishes the dataset. `trilight submit
kubernetes` makes such jobs (pipeline.executors.kubernetes_array). It has not run on a real cluster
yet; tests give tasks the variables that the manual documents.
"""

import os
from collections.abc import Mapping

from pipeline.executors.threads import make_part, number, variable
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome
from storage.errors import TrilightError
from storage.number_ranges import MOST_NUMBERS, numbers_of

PLACE = "JOB_COMPLETION_INDEX"
"""Variable with the index of a task in the Job, from 0."""


def make(options: GenerateOptions, address: str | None) -> Outcome:
    """Make the shards of this task.

    Raises:
        TrilightError: this is no task of an indexed Job, or as `make_part`.
    """
    return make_part(options, "kubernetes", lambda: shards_of_place(os.environ))


def shards_of_place(environment: Mapping[str, str]) -> str:
    """Return the range A:B of shards of this task.

    Args:
        environment: variables that Kubernetes and the Job's manifest set.

    Raises:
        TrilightError: a variable is missing or malformed, or the index is beyond the tasks.
    """
    text = variable(environment, "TASKS", "kubernetes")
    tasks = numbers_of(text)
    if not tasks:
        raise TrilightError(
            f"--runner kubernetes: TASKS is {text!r:.60}; expected numbers of tasks such as "
            f"0-3,7, at most {MOST_NUMBERS}."
        )
    each = number(environment, "SHARDS_PER_TASK", "kubernetes", least=1)
    place = number(environment, PLACE, "kubernetes", least=0)
    if place >= len(tasks):
        raise TrilightError(
            f"--runner kubernetes: {PLACE} is {place}; expected a place below {len(tasks)}, "
            "the number of tasks in TASKS. Submit the array as trilight submit made it."
        )
    return f"{tasks[place] * each}:{(tasks[place] + 1) * each}"
