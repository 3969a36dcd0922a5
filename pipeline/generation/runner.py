"""`Runner`: the interface between the engine and the executors that run its tasks.

The engine imports no executor: threads and Slurm are in pipeline.executors, Prefect and Dask in
pipeline.flows, and a user may add another. A runner takes tasks one by one as it has room, and
yields their results as they end: memory does not grow with the number of tasks, and no finished
task waits for a slow one.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Generic, Protocol, TypeVar

from pipeline.generation.generation_run import ShardJob, TaskResult
from pipeline.generation.tasks import Piece
from storage.dataset.statistics import Statistics


class Submitted(Protocol):
    """Future of a task, such as concurrent.futures.Future."""

    def result(self) -> TaskResult:
        """Return the result of an ended task, or raise its error."""
        ...


Future = TypeVar("Future", bound=Submitted)


class Runner(ABC, Generic[Future]):
    """Runs `pipeline.generation.pipeline.make_task` once for each task, on any machine."""

    num_at_once: int | None = None
    """Parallel tasks of one process; None leaves the number to the options."""
    window: int | None = None
    """Number of submitted, unfinished tasks; None means as many as run at once."""

    @abstractmethod
    def submit(self, task: tuple[Piece, ...], job: ShardJob) -> Future:
        """Start a task, and return its future at once."""

    @abstractmethod
    def wait_any(self, running: list[Future]) -> Future:
        """Wait until one of these tasks has ended, and return it."""

    def close(self) -> None:
        """Release what submitted tasks hold, also after an error."""

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskResult]:
        """Yield the result of each task, in the order in which the tasks end.

        The next task is submitted before a result is yielded: the caller may take long over it.

        Raises:
            TrilightError: a task failed permanently; finished scenes stay on disk.
        """
        waiting = iter(tasks)
        window = self.window or job.num_at_once
        try:
            running = [self.submit(task, job) for task in islice(waiting, window)]
            while running:
                done = self.wait_any(running)
                running.remove(done)
                result = done.result()
                free = window - len(running)
                running += [self.submit(task, job) for task in islice(waiting, free)]
                yield result
        finally:
            self.close()

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call `write_documents`; an executor may limit its parallel calls, which read all data."""
        return write_documents()
