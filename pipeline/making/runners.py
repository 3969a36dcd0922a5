"""Who runs the tasks of a dataset: threads here, or a scheduler (pipeline.flows.served).

A runner takes tasks one by one as it has room, and gives their outcomes as they come: memory does
not grow with the number of tasks, and no finished task waits for a slow one.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Protocol, TypeVar

from pipeline.making.make_task import ShardJob, TaskOutcome, make_task
from pipeline.making.pieces import Piece
from storage.dataset.statistics import Statistics

Task = TypeVar("Task")
Waiting = TypeVar("Waiting")
Result = TypeVar("Result")


class Runner(Protocol):
    """Runs `make_task` for each task."""

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
        """Call what finishes a dataset; few may at the same time, since it reads all of it."""


class ThreadRunner:
    """Threads of this process, each with its render child; no server, no scheduler."""

    num_at_once = None
    window = None

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskOutcome]:
        pool = ThreadPoolExecutor(job.num_at_once)
        try:
            yield from in_window(
                tasks,
                submit=lambda task: pool.submit(make_task, job, task),
                first_done=_first_done,
                result=lambda future: future.result(),
                window=job.num_at_once,
            )
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        return write_documents()


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


def _first_done(running: list["Future[TaskOutcome]"]) -> "Future[TaskOutcome]":
    return next(iter(wait(running, return_when=FIRST_COMPLETED).done))
