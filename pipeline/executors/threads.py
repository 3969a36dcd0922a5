"""`--runner threads`: runs tasks on threads of this process, each with its own render child."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from pipeline.generation.dataset_order import DatasetOrder
from pipeline.generation.pipeline import make_dataset, make_task
from pipeline.generation.run import Outcome, ShardJob, TaskResult
from pipeline.generation.runner import in_window
from pipeline.generation.tasks import Piece
from storage.dataset.statistics import Statistics


def make(order: DatasetOrder, address: str | None) -> Outcome:
    """Make a dataset here; raises as `make_dataset`."""
    return make_dataset(order, ThreadRunner())


class ThreadRunner:
    """Runs each task on one of `job.num_at_once` threads; native code runs in render children."""

    num_at_once = None
    window = None

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskResult]:
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


def _first_done(running: list["Future[TaskResult]"]) -> "Future[TaskResult]":
    return next(iter(wait(running, return_when=FIRST_COMPLETED).done))
