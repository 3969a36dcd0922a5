"""`--runner threads`: runs tasks on threads of this process, each with its own render child.

Tasks of a scheduler's array (pipeline.executors.slurm, pipeline.executors.kubernetes) make their
part of the shards so.
"""

import dataclasses
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome, ShardJob, TaskResult
from pipeline.generation.pipeline import make_dataset, make_task
from pipeline.generation.runner import Runner
from pipeline.generation.tasks import Piece
from storage.errors import TrilightError


def make(options: GenerateOptions, address: str | None) -> Outcome:
    """Make a dataset here; raises as `make_dataset`."""
    return make_dataset(options, ThreadRunner())


def make_part(options: GenerateOptions, runner: str, shards: Callable[[], str]) -> Outcome:
    """Make the shards of one task of an array.

    Args:
        options: options of the dataset.
        runner: name of the executor, for messages.
        shards: returns the range A:B of this task.

    Raises:
        TrilightError: the options have a range of shards; as `shards`, or as `make_dataset`.
    """
    if options.shards is not None:
        raise TrilightError(
            f"--shards is {options.shards}; expected none with --runner {runner}: the task's place "
            "in the array says which shards are made. Omit one of the two."
        )
    return make_dataset(dataclasses.replace(options, shards=shards()), ThreadRunner())


def variable(environment: Mapping[str, str], name: str, runner: str) -> str:
    """Return a variable of an array's task; raises TrilightError if it is not set."""
    if name not in environment:
        raise TrilightError(
            f"--runner {runner}: {name} is not set; expected a task of an array, as trilight "
            f"submit {runner} makes it. Submit one, or choose another --runner."
        )
    return environment[name]


def number(environment: Mapping[str, str], name: str, runner: str, *, least: int) -> int:
    """Return a number of an array's task; raises TrilightError if it is missing or none."""
    text = variable(environment, name, runner)
    if not (text.isascii() and text.isdecimal()) or int(text) < least:
        raise TrilightError(
            f"--runner {runner}: {name} is {text!r:.60}; expected a number from {least}."
        )
    return int(text)


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
