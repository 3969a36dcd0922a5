"""Runs tasks on threads of this process, each with its own render child: `--runner threads`.

`--runner slurm` and `--runner kubernetes` make the shards of one task of an array so. No task
submits another, and none waits for another: they share the folder or bucket that `--out` names, and
the task that makes the last shard finishes the dataset. `trilight submit` makes such arrays
(pipeline.executors.slurm_and_kubernetes), and so does infra/slurm/generate.sbatch. None has run on
a real cluster yet; tests give tasks the variables that the manuals document.

Kubernetes starts the same container with the index 0, 1, 2, ... in JOB_COMPLETION_INDEX, and again
with the same index when a task is lost. TASKS maps each index to a task, such as 0-3,7, so that
only missing shards are made.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import (
    Outcome,
    Piece,
    Runner,
    ShardJob,
    TaskResult,
    shard_ranges,
)
from pipeline.generation.pipeline import make_dataset, make_task, prepare_dataset
from storage.errors import TrilightError
from storage.number_ranges import MOST_NUMBERS, numbers_of


class ThreadRunner(Runner[Future[TaskResult]]):
    """Runs each task on one of `job.num_at_once` threads; native code runs in render children."""

    _pool: ThreadPoolExecutor | None = None

    def submit(self, task: tuple[Piece, ...], job: ShardJob) -> Future[TaskResult]:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(job.num_at_once)
        return self._pool.submit(make_task, job, task)

    def wait_any(self, running: list[Future[TaskResult]]) -> Future[TaskResult]:
        return next(iter(wait(running, return_when=FIRST_COMPLETED).done))

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None


def make(options: GenerateOptions, address: str | None) -> Outcome:
    """Make a dataset here; raises as `make_dataset`."""
    return make_dataset(options, ThreadRunner())


PLACE = "JOB_COMPLETION_INDEX"
"""Variable with the index of a task in a Job of Kubernetes, from 0."""


def make_slurm(options: GenerateOptions, address: str | None) -> Outcome:
    """Make the shards of a task of a Slurm array; raises as `shards_of_task` and `make_dataset`."""
    _require_whole(options, "slurm")
    shards = shards_of_task(os.environ, lambda: prepare_dataset(options).publication.num_shards)
    return make(dataclasses.replace(options, shards=shards), address)


def make_kubernetes(options: GenerateOptions, address: str | None) -> Outcome:
    """Make the shards of a task of an indexed Job; as `shards_of_place` and `make_dataset`."""
    _require_whole(options, "kubernetes")
    return make(dataclasses.replace(options, shards=shards_of_place(os.environ)), address)


def _require_whole(options: GenerateOptions, runner: str) -> None:
    if options.shards is not None:
        raise TrilightError(
            f"--range is {options.shards}; expected none with --runner {runner}: the task's place "
            "in the array says which shards are made. Omit one of the two."
        )


def shards_of_task(environment: Mapping[str, str], num_shards: Callable[[], int]) -> str:
    """Return the range A:B of shards of a task of a Slurm array.

    With SHARDS_PER_TASK it depends on SLURM_ARRAY_TASK_ID alone, so that single tasks can be
    submitted again. Without it, all tasks get equal ranges; if there are more tasks than shards,
    several tasks get the same range.

    Args:
        num_shards: returns the number of shards of the dataset; called only if it is needed.

    Raises:
        TrilightError: a variable is missing or not a number, or the array has gaps.
    """
    task = _number(environment, "SLURM_ARRAY_TASK_ID", "slurm", least=0)
    if environment.get("SHARDS_PER_TASK"):
        return _range_of_task(environment, task, "slurm")
    first, last = (
        _number(environment, f"SLURM_ARRAY_TASK_{end}", "slurm", least=0) for end in ("MIN", "MAX")
    )
    count = _number(environment, "SLURM_ARRAY_TASK_COUNT", "slurm", least=1)
    step = (last - first) // (count - 1) if count > 1 else 1
    if first + step * (count - 1) != last or (task - first) % max(1, step):
        raise TrilightError(
            f"--runner slurm: the array has {count} tasks between {first} and {last}, with gaps; "
            "expected one without, such as --array=0-63. Or set SHARDS_PER_TASK: task K then makes "
            "that many shards from K times that number."
        )
    ranges = shard_ranges(num_shards(), count)
    return ranges[(task - first) // step % len(ranges)]


def shards_of_place(environment: Mapping[str, str]) -> str:
    """Return the range A:B of shards of a task of an indexed Job.

    Raises:
        TrilightError: a variable is missing or malformed, or the index is beyond the tasks.
    """
    text = _variable(environment, "TASKS", "kubernetes")
    tasks = numbers_of(text)
    if not tasks:
        raise TrilightError(
            f"--runner kubernetes: TASKS is {text!r:.60}; expected numbers of tasks such as "
            f"0-3,7, at most {MOST_NUMBERS}."
        )
    place = _number(environment, PLACE, "kubernetes", least=0)
    if place >= len(tasks):
        raise TrilightError(
            f"--runner kubernetes: {PLACE} is {place}; expected a place below {len(tasks)}, "
            "the number of tasks in TASKS. Submit the array as trilight submit made it."
        )
    return _range_of_task(environment, tasks[place], "kubernetes")


def _range_of_task(environment: Mapping[str, str], task: int, runner: str) -> str:
    each = _number(environment, "SHARDS_PER_TASK", runner, least=1)
    return f"{task * each}:{(task + 1) * each}"


def _variable(environment: Mapping[str, str], name: str, runner: str) -> str:
    if name not in environment:
        raise TrilightError(
            f"--runner {runner}: {name} is not set; expected a task of an array, as trilight "
            f"submit {runner} makes it. Submit one, or choose another --runner."
        )
    return environment[name]


def _number(environment: Mapping[str, str], name: str, runner: str, *, least: int) -> int:
    text = _variable(environment, name, runner)
    if not (text.isascii() and text.isdecimal()) or int(text) < least:
        raise TrilightError(
            f"--runner {runner}: {name} is {text!r:.60}; expected a number from {least}."
        )
    return int(text)
