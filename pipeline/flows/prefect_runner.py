"""`PrefectRunner`: runs a dataset's tasks as Prefect tasks, with retries after transient errors.

A task run is some minutes of scenes (pipeline.generation.tasks). Native code runs in our own child
processes, never in a process pool of Prefect's, which a single segfault breaks entirely.
"""

import contextlib
from collections.abc import Callable
from typing import Any

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.concurrency.sync import concurrency
from prefect.futures import PrefectFuture, as_completed
from prefect.tasks import Task, exponential_backoff

from pipeline.flows.limits import DISK_LIMIT, GPU_LIMIT
from pipeline.generation.generation_run import ShardJob, TaskResult
from pipeline.generation.pipeline import make_task
from pipeline.generation.runner import Runner
from pipeline.generation.tasks import Piece
from storage.dataset.statistics import Statistics
from storage.errors import EnvironmentFailure

_RETRIES = 3
_FIRST_DELAY_S = 10


def is_retryable(task_: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Return True if a failed task may succeed when it is tried again."""
    try:
        state.result()
    except (EnvironmentFailure, OSError, MemoryError):
        return True
    except Exception:
        return False
    return False


@task(
    name="make-scenes",
    task_run_name="shard {first}",
    cache_policy=NO_CACHE,
    persist_result=False,
    retries=_RETRIES,
    retry_delay_seconds=exponential_backoff(_FIRST_DELAY_S),
    retry_jitter_factor=0.5,
    retry_condition_fn=is_retryable,
)
def make_scenes(first: str, work: "OpaqueWork") -> TaskResult:
    """Make some pieces; `first` names their first scene on Prefect's page.

    If pictures are rendered on a GPU, GPU_LIMIT limits the tasks that run at the same time.
    """
    with _gpu_slot(work.job):
        return make_task(work.job, work.pieces)


class OpaqueWork:
    """Input of a task, wrapped so that Prefect does not search it for futures."""

    def __init__(self, job: ShardJob, pieces: tuple[Piece, ...]) -> None:
        self.job = job
        self.pieces = pieces


class PrefectRunner(Runner[PrefectFuture[TaskResult]]):
    """Submits tasks to the task runner of the current flow run."""

    def __init__(self, *, window: int | None = None, num_at_once: int | None = None) -> None:
        """Set how many tasks run at the same time.

        Args:
            window: most submitted and unfinished task runs; by default as many as run at once here.
            num_at_once: parallel tasks of one process; by default the options' number.
        """
        self.window = window
        self.num_at_once = num_at_once

    def submit(self, task: tuple[Piece, ...], job: ShardJob) -> PrefectFuture[TaskResult]:
        label = f"{task[0].shard_index} from scene {task[0].first}"
        return make_scenes.submit(label, OpaqueWork(job, task))

    def wait_any(self, running: list[PrefectFuture[TaskResult]]) -> PrefectFuture[TaskResult]:
        return next(iter(as_completed(running)))

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call `write_documents` as a task run of its own."""
        return write_documents_task(OpaqueCall(write_documents))


@task(
    name="write-documents",
    cache_policy=NO_CACHE,
    persist_result=False,
    retries=_RETRIES,
    retry_delay_seconds=exponential_backoff(_FIRST_DELAY_S),
    retry_jitter_factor=0.5,
    retry_condition_fn=is_retryable,
)
def write_documents_task(write: "OpaqueCall") -> Statistics:
    """Write the documents of a dataset; DISK_LIMIT limits how many run at the same time."""
    with concurrency(DISK_LIMIT, occupy=1, strict=False):
        return write.call()


class OpaqueCall:
    """A function, wrapped so that Prefect does not search it for futures."""

    def __init__(self, call: Callable[[], Statistics]) -> None:
        self.call = call


def _gpu_slot(job: ShardJob) -> contextlib.AbstractContextManager[None]:
    if job.device == "cpu":
        return contextlib.nullcontext()
    return concurrency(GPU_LIMIT, occupy=1, strict=False)
