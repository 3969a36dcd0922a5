"""`--runner threads`: runs tasks on threads of this process, each with its own render child."""

from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from pipeline.generation.dataset_order import DatasetOrder
from pipeline.generation.pipeline import make_dataset, make_task
from pipeline.generation.run import Outcome, ShardJob, TaskResult
from pipeline.generation.runner import Runner
from pipeline.generation.tasks import Piece


def make(order: DatasetOrder, address: str | None) -> Outcome:
    """Make a dataset here; raises as `make_dataset`."""
    return make_dataset(order, ThreadRunner())


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
