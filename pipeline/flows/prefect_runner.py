"""The tasks of a dataset as Prefect's: scheduled, displayed, and tried again where that can help.

A task run is some minutes of scenes (pipeline.making.tasks). Native code runs in children of our
own, never in a process pool of Prefect's, which one segfault breaks as a whole.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.concurrency.sync import concurrency
from prefect.futures import PrefectFuture, as_completed
from prefect.tasks import Task, exponential_backoff

from pipeline.flows.limits import DISK_LIMIT, GPU_LIMIT
from pipeline.making.pipeline import make_task
from pipeline.making.run import ShardJob, TaskOutcome
from pipeline.making.runner import in_window
from pipeline.making.tasks import Piece
from pipeline.renders.variant import choose_variant
from storage.dataset.statistics import Statistics
from storage.errors import EnvironmentFailure

_RETRIES = 3
_FIRST_DELAY_S = 10


def may_pass(task_: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Say whether a failed task is tried again: not where it would only fail once more."""
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
    retry_condition_fn=may_pass,
)
def make_scenes(first: str, work: "Sealed") -> TaskOutcome:
    """Make some pieces; `first` says for people where they begin.

    Where pictures are made on a graphics card, GPU_LIMIT says how many tasks may run at a time.
    """
    with _card():
        return make_task(work.job, work.pieces)


class Sealed:
    """What a task needs, in a form that Prefect does not search for futures, however large."""

    def __init__(self, job: ShardJob, pieces: tuple[Piece, ...]) -> None:
        self.job = job
        self.pieces = pieces


class PrefectRunner:
    """Task runs of the flow run that is going on, by that flow's task runner."""

    def __init__(self, *, window: int | None = None, num_at_once: int | None = None) -> None:
        """Say how much runs at the same time.

        Args:
            window: task runs that are submitted and not finished, at most; by default as many as
                run at once here.
            num_at_once: tasks at a time in one process; by default what the order says.
        """
        self.window = window
        self.num_at_once = num_at_once

    def run(self, tasks: Iterable[tuple[Piece, ...]], job: ShardJob) -> Iterator[TaskOutcome]:
        """Yield outcomes as they come; raises what a task raised after its last try."""
        return in_window(
            tasks,
            submit=lambda pieces: make_scenes.submit(_named(pieces), Sealed(job, pieces)),
            first_done=_first_done,
            result=lambda future: future.result(),
            window=self.window or job.num_at_once,
        )

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call what finishes a dataset as a task run of its own."""
        return write_documents_task(Deferred(write_documents))


@task(
    name="write-documents",
    cache_policy=NO_CACHE,
    persist_result=False,
    retries=_RETRIES,
    retry_delay_seconds=exponential_backoff(_FIRST_DELAY_S),
    retry_jitter_factor=0.5,
    retry_condition_fn=may_pass,
)
def write_documents_task(write: "Deferred") -> Statistics:
    """Write what people and hubs look at; DISK_LIMIT says how many may at the same time."""
    with concurrency(DISK_LIMIT, occupy=1, strict=False):
        return write.call()


class Deferred:
    """A call that Prefect does not look into."""

    def __init__(self, call: Callable[[], Statistics]) -> None:
        self.call = call


def _card() -> contextlib.AbstractContextManager[None]:
    if choose_variant().name != "cuda_ad_rgb":
        return contextlib.nullcontext()
    return concurrency(GPU_LIMIT, occupy=1, strict=False)


def _first_done(running: list[PrefectFuture[TaskOutcome]]) -> PrefectFuture[TaskOutcome]:
    return next(iter(as_completed(running)))


def _named(pieces: tuple[Piece, ...]) -> str:
    return f"{pieces[0].shard_index} from scene {pieces[0].first}"
