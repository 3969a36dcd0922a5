"""`Runner`: the interface between the engine and the executors that run its tasks.

The engine imports no executor: threads and Slurm are in pipeline.executors, Prefect and Dask in
pipeline.flows, and a user may add another. A runner takes tasks one by one as it has room, and
yields their results as they end: memory does not grow with the number of tasks, and no finished
task waits for a slow one.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

from pipeline.generation.run import ShardJob, TaskResult
from pipeline.generation.tasks import Piece
from storage.dataset.statistics import Statistics

Task = TypeVar("Task")
Waiting = TypeVar("Waiting")
Result = TypeVar("Result")


class Runner(Protocol):
    """Runs `pipeline.generation.pipeline.make_task` once for each task, on any machine."""

    @property
    def num_at_once(self) -> int | None:
        """Parallel tasks of one process; None leaves the number to the options."""

    @property
    def window(self) -> int | None:
        """Number of submitted, unfinished tasks; None means `num_at_once`."""

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskResult]:
        """Yield the result of each task, in the order in which the tasks end.

        Raises:
            TrilightError: a task failed permanently; finished scenes stay on disk.
        """

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call `write_documents`; limit its parallel calls, since each reads the whole dataset."""


def in_window(
    tasks: Iterable[Task],
    *,
    submit: Callable[[Task], Waiting],
    first_done: Callable[[list[Waiting]], Waiting],
    result: Callable[[Waiting], Result],
    window: int,
) -> Iterator[Result]:
    """Yield results as tasks end, with at most `window` tasks submitted at a time.

    The next task is submitted before a result is yielded, since the caller may take long over it.
    """
    waiting = iter(tasks)
    running: list[Waiting] = []

    def fill() -> None:
        while len(running) < window and (task := next(waiting, None)) is not None:
            running.append(submit(task))

    fill()
    while running:
        done = first_done(running)
        running.remove(done)
        outcome = result(done)
        fill()
        yield outcome
