"""`Runner`: the one interface between the engine and who runs its tasks.

The engine knows none of them: threads and Slurm are in pipeline.executors, Prefect and Dask in
pipeline.flows, and a user may bring another. A runner takes tasks one by one as it has room, and
gives their outcomes as they come: memory does not grow with the number of tasks, and no finished
task waits for a slow one.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol, TypeVar

from pipeline.making.run import ShardJob, TaskOutcome
from pipeline.making.tasks import Piece
from storage.dataset.statistics import Statistics

Task = TypeVar("Task")
Waiting = TypeVar("Waiting")
Result = TypeVar("Result")


class Runner(Protocol):
    """Runs `pipeline.making.pipeline.make_task` for each task, somewhere."""

    @property
    def num_at_once(self) -> int | None:
        """Tasks at a time in one process, or None where the order says."""

    @property
    def window(self) -> int | None:
        """Tasks that are handed out at a time, or None where that is `num_at_once`."""

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskOutcome]:
        """Yield what became of each task, in the order in which they end.

        Raises:
            TrilightError: a task failed for good; what is finished is safe.
        """

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call what writes the documents; few may at the same time: it reads the whole dataset."""


def in_window(
    tasks: Iterable[Task],
    *,
    submit: Callable[[Task], Waiting],
    first_done: Callable[[list[Waiting]], Waiting],
    result: Callable[[Waiting], Result],
    window: int,
) -> Iterator[Result]:
    """Yield results as they come, with at most `window` tasks handed out at a time.

    The next task is handed out before a result is: whoever takes it may take long over it.
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
