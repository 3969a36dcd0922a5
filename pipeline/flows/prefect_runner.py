"""`PrefectRunner`: runs a dataset's tasks as Prefect tasks; `RunPage` shows them on its page.

A task run is some minutes of scenes (pipeline.generation.generation_run), with retries after
transient errors. Native code runs in our own child processes, never in a process pool of Prefect's,
which a single segfault breaks entirely.

The page shows progress, a table, a summary, and a picture of the scenes. All numbers come from the
dataset's files (`trilight status` shows the same). The artifacts decide nothing, and a run
continues if they cannot be written.
"""

import dataclasses
import io
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, cast
from uuid import UUID

from PIL import Image
from prefect import task
from prefect.artifacts import (
    create_image_artifact,
    create_link_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.concurrency.sync import concurrency
from prefect.futures import PrefectFuture, as_completed
from prefect.logging import get_run_logger
from prefect.tasks import Task, exponential_backoff

from pipeline.documents.pages import data_uri
from pipeline.flows.prefect_server import DISK_LIMIT, GPU_LIMIT
from pipeline.generation.generate_options import PRICES, CorePrice, GenerateOptions
from pipeline.generation.generation_run import Outcome, Piece, Run, Runner, ShardJob, TaskResult
from pipeline.generation.pipeline import make_dataset, make_task
from storage.dataset.layout import dataset_folder
from storage.dataset.progress import DatasetStatus, read_status
from storage.dataset.splits import scenes_of_shard
from storage.dataset.statistics import Statistics
from storage.errors import EnvironmentFailure, TrilightError
from storage.remote.url import safe_text


def is_retryable(task_: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Return True if a failed task may succeed when it is tried again."""
    try:
        state.result()
    except Exception as error:
        return isinstance(error, EnvironmentFailure | OSError | MemoryError)
    return False


_RETRIED: dict[str, Any] = {
    "cache_policy": NO_CACHE,
    "persist_result": False,
    "retries": 3,
    "retry_delay_seconds": exponential_backoff(10),
    "retry_jitter_factor": 0.5,
    "retry_condition_fn": is_retryable,
}


@task(name="make-scenes", task_run_name="shard {first}", **_RETRIED)
def make_scenes(first: str, make: Callable[[], TaskResult], *, on_gpu: bool) -> TaskResult:
    """Make some pieces; `first` names their first scene on Prefect's page.

    If pictures are rendered on a GPU, GPU_LIMIT limits the tasks that run at the same time.
    `make` is a `partial`, in which Prefect searches for no futures.
    """
    with concurrency(GPU_LIMIT, occupy=1, strict=False) if on_gpu else nullcontext():
        return make()


@task(name="write-documents", **_RETRIED)
def write_documents_task(write: Callable[[], Statistics]) -> Statistics:
    """Write the documents of a dataset; DISK_LIMIT limits how many run at the same time."""
    with concurrency(DISK_LIMIT, occupy=1, strict=False):
        return write()


class PrefectRunner(Runner[PrefectFuture[TaskResult]]):
    """Submits tasks to the task runner of the current flow run."""

    def submit(self, task: tuple[Piece, ...], job: ShardJob) -> PrefectFuture[TaskResult]:
        label = f"{task[0].shard_index} from scene {task[0].first}"
        return make_scenes.submit(label, partial(make_task, job, task), on_gpu=job.device != "cpu")

    def wait_any(self, running: list[PrefectFuture[TaskResult]]) -> PrefectFuture[TaskResult]:
        return next(iter(as_completed(running)))

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call `write_documents` as a task run of its own."""
        return write_documents_task(write_documents)


_EVERY_S = 15.0
"""Seconds between two tables; each is a row of Prefect's database."""
_SHEET_PX = 1024
"""Longest side of the contact sheet on the page: about 100 kB."""


def make_with_page(options: GenerateOptions, runner: Runner) -> Outcome:
    """Make a dataset within a flow run and show its progress; the summary includes failures."""
    # one line per scene; PREFECT_LOGGING_EXTRA_LOGGERS=trilight brings it to the server
    logging.getLogger("trilight").setLevel(logging.INFO)
    page = RunPage(options.place)
    try:
        outcome = make_dataset(options, runner, page.record_task)
    except Exception as error:
        page.show_failure(error)
        raise
    page.show_result(outcome.statistics)
    return outcome


class RunPage:
    """What the page of a run shows of its dataset; an error of the page does not end the run."""

    def __init__(self, place: str) -> None:
        """Create the first artifact of a run, for a dataset of a path or URL.

        Raises:
            TrilightError: TRILIGHT_USD_PER_CORE_HOUR is not a valid price.
        """
        self._place = place
        self._price = usd_per_core_hour()
        self._rows: list[tuple[str, str]] = []
        self._run: Run | None = None
        self._began_s = 0.0
        self._scenes = 0
        self._core_s = 0.0
        self._shown_s = -_EVERY_S
        self._log = get_run_logger()
        self._warned = False
        self._progress: UUID | None = None
        with self._showing():
            # Prefect's functions return coroutines only where an event loop runs
            artifact = create_progress_artifact(0.0, key="shards", description=place)
            self._progress = cast(UUID, artifact)

    def record_task(self, run: Run, outcome: TaskResult) -> None:
        """Log the shards of a finished task, and show the progress if it was shown long ago."""
        now_s = time.monotonic()
        if self._run is None:
            self._run = run
            self._began_s = now_s - outcome.seconds  # objects are prepared before
        self._scenes += outcome.scenes
        self._core_s += outcome.core_s
        for shard in outcome.shards:
            self._log.info("shard %s: %d scenes", shard.name, shard.num_samples)
        if now_s - self._shown_s >= _EVERY_S:
            self._shown_s = now_s
            with self._showing():
                self.show_status(self._read_status())

    def _read_status(self) -> DatasetStatus:
        """Return the status of the dataset; of a run of a range, that of its shards and tasks."""
        status = read_status(self._place)
        run = self._run
        if run is None or (requested := run.options.shard_range()) is None:
            return status
        writer = run.publication
        shards = range(writer.num_shards)[requested.start : requested.stop]
        missing = writer.missing_shards(shards)
        planned, missing_scenes = (
            sum(len(scenes_of_shard(index, writer.splits)) for index in some)
            for some in (shards, missing)
        )
        per_s = self._scenes / max(time.monotonic() - self._began_s, 1e-3)
        return dataclasses.replace(
            status,
            shards_done=len(shards) - len(missing),
            shards_planned=len(shards),
            scenes_done=planned - missing_scenes - writer.given_up,
            scenes_given_up=writer.given_up,
            scenes_planned=planned,
            views_per_hour=3600 * per_s * writer.manifest.num_views,
            remaining_s=missing_scenes / per_s if per_s else None,
            core_hours=self._core_s / 3600,
        )

    def show_status(self, status: DatasetStatus) -> None:
        """Show the progress of the dataset, if it has changed."""
        remaining_s = status.remaining_s
        rate = "unknown" if status.views_per_hour is None else f"{status.views_per_hour:.4g}"
        remaining = "unknown" if remaining_s is None else f"{remaining_s / 60:.0f} minutes"
        rows = [
            ("scenes in shards", f"{status.scenes_done} of {status.scenes_planned}"),
            ("views an hour", rate),
            ("left at that rate", remaining),
        ]
        if rows != self._rows:
            self._rows = rows
            with self._showing():
                self._tell(status, "progress", rows)

    def show_result(self, statistics: Statistics | None = None) -> None:
        """Show the final counts, and the pictures of a finished dataset that are on this machine.

        Args:
            statistics: of the dataset, if this run has finished it.
        """
        with self._showing():
            status = self._read_status()
            rows = [("dataset digest", status.digest), *(statistics.lines() if statistics else ())]
            if status.finished:  # Prefect's page cannot show files of the worker, only their path
                rows.append(("report", f"{self._place}/report.html"))
            self._tell(status, "summary", rows)
            done = f"{status.shards_done} of {status.shards_planned}"
            self._log.info("%s shards are there; digest %s", done, status.digest)
            if status.finished and (url := report_url(self._place)):
                create_link_artifact(url, key="report", link_text="report")
            sheet = dataset_folder(self._place).contact_sheet
            if sheet.exists():
                picture = small_picture(sheet)
                create_image_artifact(picture, key="contact-sheet", description=self._place)

    def show_failure(self, error: Exception) -> None:
        """Show why the run ended early; finished scenes stay on disk."""
        what = safe_text(f"{type(error).__name__}: {error}".partition("\n")[0])
        made = ("scenes of this run", str(self._scenes))
        cost = ("cost of this run", self._cost(self._core_s / 3600))
        with self._showing():
            self._tell_table("summary", [("failed", what), made, cost])

    @contextmanager
    def _showing(self) -> Iterator[None]:
        """Log the first error within all such blocks, and never raise one."""
        try:
            yield
        except Exception as error:  # a server that is down for a moment must not cost hours of work
            if not self._warned:
                self._warned = True
                why = safe_text(str(error).partition("\n")[0])
                self._log.warning("what this page shows is not complete (%s)", why)

    def _tell(self, status: DatasetStatus, key: str, more: Sequence[tuple[str, str]] = ()) -> None:
        over = status.scenes_done + status.scenes_given_up
        if self._progress is not None:
            percent = 100.0 * over / max(status.scenes_planned, 1)
            update_progress_artifact(self._progress, percent)
        rows = [
            ("shards", f"{status.shards_done} of {status.shards_planned}"),
            *more,
            *((f"rejected: {why} ({stage})", str(count)) for stage, why, count in status.failures),
            ("cost", self._cost(status.core_hours or 0.0)),
        ]
        self._tell_table(key, rows)

    def _cost(self, core_hours: float) -> str:
        return f"{core_hours:.3f} core-hours, {core_hours * self._price:.2f} USD"

    def _tell_table(self, key: str, rows: Sequence[tuple[str, str]]) -> None:
        table = [{"what": name, "value": value} for name, value in rows]
        create_table_artifact(table, key, description=self._place)


def usd_per_core_hour() -> float:
    """Return the price of a core-hour in USD.

    Raises:
        TrilightError: TRILIGHT_USD_PER_CORE_HOUR is not a valid price.
    """
    text = os.environ.get("TRILIGHT_USD_PER_CORE_HOUR", str(CorePrice().price))
    try:
        return CorePrice(price=float(text)).price
    except ValueError as error:
        raise TrilightError(
            f"TRILIGHT_USD_PER_CORE_HOUR is {text!r}; expected a number {PRICES}, such as 0.04."
        ) from error


def report_url(out: str) -> str | None:
    """Return the report's URL below TRILIGHT_PUBLIC_URL, which serves datasets; None without it."""
    base = os.environ.get("TRILIGHT_PUBLIC_URL", "").rstrip("/")
    return f"{base}/{Path(out).name}/report.html" if base else None


def small_picture(path: Path) -> str:
    """Return a picture as a data URI, at most _SHEET_PX wide and high."""
    stream = io.BytesIO()
    with Image.open(path) as picture:
        small = picture.convert("RGB")
    small.thumbnail((_SHEET_PX, _SHEET_PX))
    small.save(stream, "JPEG", quality=85)
    return data_uri(stream.getvalue(), "jpeg")
