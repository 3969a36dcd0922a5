"""`PrefectRunner`: runs a dataset's tasks as Prefect tasks; `RunArtifacts` shows them on its page.

A task run is some minutes of scenes (pipeline.generation.generation_run), with retries after
transient errors. Native code runs in our own child processes, never in a process pool of Prefect's,
which a single segfault breaks entirely.

The page shows progress, a table, a summary, and a picture of the scenes. All numbers come from the
dataset's files (`trilight status` shows the same). The artifacts decide nothing, and a run
continues if they cannot be written.
"""

import base64
import io
import logging
import os
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
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

from pipeline.flows.prefect_server import DISK_LIMIT, GPU_LIMIT
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.generation_run import Outcome, Piece, Run, Runner, ShardJob, TaskResult
from pipeline.generation.pipeline import make_dataset, make_task
from pipeline.generation.price import PRICES, USD_PER_CORE_HOUR
from storage.dataset.layout import dataset_folder
from storage.dataset.statistics import Statistics
from storage.errors import EnvironmentFailure, TrilightError
from storage.records.objects import count_by_reason, read_failures
from storage.remote.safe_url import safe_text


def is_retryable(task_: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Return True if a failed task may succeed when it is tried again."""
    try:
        state.result()
    except (EnvironmentFailure, OSError, MemoryError):
        return True
    except Exception:
        return False
    return False


_RETRIED: dict[str, Any] = {
    "cache_policy": NO_CACHE,
    "persist_result": False,
    "retries": 3,
    "retry_delay_seconds": exponential_backoff(10),
    "retry_jitter_factor": 0.5,
    "retry_condition_fn": is_retryable,
}


class Opaque:
    """A function without arguments, wrapped so that Prefect does not search it for futures.

    Not a dataclass: Prefect would search its fields.
    """

    def __init__(self, call: Callable[[], Any], *, on_gpu: bool = False) -> None:
        self.call = call
        self.on_gpu = on_gpu


@task(name="make-scenes", task_run_name="shard {first}", **_RETRIED)
def make_scenes(first: str, work: Opaque) -> TaskResult:
    """Make some pieces; `first` names their first scene on Prefect's page.

    If pictures are rendered on a GPU, GPU_LIMIT limits the tasks that run at the same time.
    """
    slot = concurrency(GPU_LIMIT, occupy=1, strict=False) if work.on_gpu else nullcontext()
    with slot:
        result: TaskResult = work.call()
        return result


@task(name="write-documents", **_RETRIED)
def write_documents_task(write: Opaque) -> Statistics:
    """Write the documents of a dataset; DISK_LIMIT limits how many run at the same time."""
    with concurrency(DISK_LIMIT, occupy=1, strict=False):
        statistics: Statistics = write.call()
        return statistics


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
        work = Opaque(partial(make_task, job, task), on_gpu=job.device != "cpu")
        return make_scenes.submit(label, work)

    def wait_any(self, running: list[PrefectFuture[TaskResult]]) -> PrefectFuture[TaskResult]:
        return next(iter(as_completed(running)))

    def finish(self, write_documents: Callable[[], Statistics]) -> Statistics:
        """Call `write_documents` as a task run of its own."""
        return write_documents_task(Opaque(write_documents))


_EVERY_S = 15.0
"""Seconds between two tables; each is a row of Prefect's database."""
_SHEET_PX = 1024
"""Longest side of the contact sheet on the page: about 100 kB."""


def make_with_artifacts(options: GenerateOptions, runner: Runner) -> Outcome:
    """Make a dataset within a flow run and show its artifacts; the summary includes failures."""
    # one line per scene; PREFECT_LOGGING_EXTRA_LOGGERS=trilight brings it to the server
    logging.getLogger("trilight").setLevel(logging.INFO)
    watched = RunArtifacts(options)
    try:
        outcome = make_dataset(options, runner, watched.record_task)
    except Exception as error:
        watched.show_failure(error)
        raise
    watched.show_result(outcome)
    return outcome


class ArtifactPage:
    """The progress and the tables of a dataset on the page of a run; errors do not end the run."""

    def __init__(self, place: str) -> None:
        """Create the first artifact of a run, for a dataset of a path or URL."""
        self._place = place
        self._folder = dataset_folder(place)
        self._progress: UUID | None = None
        self._log = get_run_logger()
        self._warned = False
        self._show(self._begin)

    def _show(self, show: Callable[[], object]) -> None:
        """Show something; log the first error, and never raise."""
        try:
            show()
        except Exception as error:  # a server that is down for a moment must not cost hours of work
            if not self._warned:
                self._warned = True
                why = safe_text(str(error).partition("\n")[0])
                self._log.warning("what this page shows is not complete (%s)", why)

    def _begin(self) -> None:
        # Prefect's functions return coroutines only where an event loop runs
        self._progress = cast(
            UUID, create_progress_artifact(0.0, key="shards", description=self._place)
        )

    def _tell_percent(self, percent: float) -> None:
        if self._progress is not None:
            update_progress_artifact(self._progress, percent)

    def _tell_table(self, key: str, rows: Sequence[tuple[str, str]]) -> None:
        table = [{"what": name, "value": value} for name, value in rows]
        create_table_artifact(table, key, description=self._place)

    def _tell_sheet(self) -> None:
        sheet = small_picture(self._folder.contact_sheet)
        create_image_artifact(sheet, key="contact-sheet", description=self._place)


class RunArtifacts(ArtifactPage):
    """The artifacts of one flow run."""

    def __init__(self, options: GenerateOptions) -> None:
        """Create the first artifact of a run.

        Raises:
            TrilightError: TRILIGHT_USD_PER_CORE_HOUR is not a valid price.
        """
        self._price = usd_per_core_hour()
        self._began: float | None = None  # the first scene; objects are prepared before
        self._shown_s = -_EVERY_S
        self._scenes = 0
        self._core_s = 0.0
        self._run: Run | None = None
        super().__init__(options.place)

    def record_task(self, run: Run, outcome: TaskResult) -> None:
        """Record a finished task, and show a new table if the last one is old."""
        now = time.monotonic()
        if self._began is None and outcome.scenes:
            self._began = now - outcome.seconds
        self._run = run
        self._scenes += outcome.scenes
        self._core_s += outcome.core_s
        for shard in outcome.shards:
            self._log.info("shard %s: %d scenes", shard.name, shard.num_samples)
        if now - self._shown_s >= _EVERY_S:
            self._shown_s = now
            self._show(lambda: self._tell(run))

    def show_result(self, outcome: Outcome) -> None:
        if (run := self._run) is not None:
            self._show(lambda: self._tell(run))
        self._show(lambda: self._sum_up(outcome))
        done = outcome.num_shards
        planned = outcome.num_shards_planned
        self._log.info("%d of %d shards are there; digest %s", done, planned, outcome.digest)

    def show_failure(self, error: Exception) -> None:
        """Show why the run ended early; finished scenes stay on disk."""
        what = safe_text(f"{type(error).__name__}: {error}".partition("\n")[0])
        made = ("scenes of this run", str(self._scenes))
        self._show(lambda: self._table("summary", [("failed", what), made]))

    def scenes_per_s(self) -> float:
        """Return scenes per second since this run's first scene began; 0 before one is made."""
        return self._scenes / (time.monotonic() - self._began) if self._began is not None else 0.0

    def _tell(self, run: Run) -> None:
        writer = run.publication
        of = writer.progress
        done = of.scenes
        planned = of.scenes_requested
        per_s = self.scenes_per_s()
        remaining = "unknown" if per_s == 0 else f"{(planned - done) / per_s / 60:.0f} minutes"
        self._tell_percent(100.0 * done / planned)
        self._table(
            "progress",
            [
                ("shards", f"{of.shards} of {of.shards_requested}"),
                ("scenes in shards", f"{done - of.given_up} of {planned}"),
                ("views an hour", f"{3600 * per_s * writer.manifest.num_views:.0f}"),
                ("left for this run alone", remaining),
            ],
        )

    def _sum_up(self, outcome: Outcome) -> None:
        done = outcome.num_shards
        planned = outcome.num_shards_planned
        self._tell_percent(100.0 * done / planned)
        rows = [("shards", f"{done} of {planned}"), ("dataset digest", outcome.digest)]
        rows += outcome.statistics.lines() if outcome.statistics else []
        if outcome.statistics is None:
            self._table("summary", rows)
            return
        # Prefect's page cannot show files of the worker, only their path
        self._table("summary", [*rows, ("report", f"{self._place}/report.html")])
        if url := report_url(self._place):
            create_link_artifact(url, key="report", link_text="report")
        self._tell_sheet()

    def _table(self, key: str, rows: Sequence[tuple[str, str]]) -> None:
        rejected = count_by_reason(read_failures(self._folder.failures))
        core_hours = self._core_s / 3600
        cost = f"{core_hours:.3f} core-hours, {core_hours * self._price:.2f} USD"
        everything = [
            *rows,
            *((f"rejected: {reason} ({stage})", str(count)) for stage, reason, count in rejected),
            ("cost of this run", cost),
        ]
        self._tell_table(key, everything)


def usd_per_core_hour() -> float:
    """Return the price of a core-hour in USD.

    Raises:
        TrilightError: TRILIGHT_USD_PER_CORE_HOUR is not a valid price.
    """
    text = os.environ.get("TRILIGHT_USD_PER_CORE_HOUR", str(USD_PER_CORE_HOUR))
    try:
        price = float(text)
    except ValueError:
        price = float("nan")
    if not PRICES.holds(price):
        raise TrilightError(
            f"TRILIGHT_USD_PER_CORE_HOUR is {text!r}; expected a number {PRICES}, such as 0.04."
        )
    return price


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
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"
