"""What people watch on Prefect's page: progress, a table, a summary, a picture of the scenes.

It shows what the files say (`trilight status` says the same); nothing is decided by it, and a run
goes on where it cannot be shown.
"""

import base64
import io
import logging
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast
from uuid import UUID

from PIL import Image
from prefect.artifacts import (
    create_image_artifact,
    create_link_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.logging import get_run_logger

from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.pipeline import make_dataset
from pipeline.making.price import PRICES, USD_PER_CORE_HOUR
from pipeline.making.run import Outcome, Run, TaskOutcome
from pipeline.making.runner import Runner
from storage.dataset.layout import dataset_folder
from storage.errors import TrilightError
from storage.records.objects import count_by_reason, read_failures
from storage.remote.safe_url import safe_text

_EVERY_S = 15.0
"""Between two tables; each is a row of Prefect's database."""
_SHEET_PX = 1024
"""Longest side of the contact sheet there: about 100 kB."""


def make_watched(order: DatasetOrder, runner: Runner) -> Outcome:
    """Make a dataset within a flow run, with its artifacts; the summary also says what failed."""
    # one line per scene; PREFECT_LOGGING_EXTRA_LOGGERS=trilight brings it to the server
    logging.getLogger("trilight").setLevel(logging.INFO)
    watched = Watched(order)
    try:
        outcome = make_dataset(order, runner, watched.task_done)
    except Exception as error:
        watched.failed(error)
        raise
    watched.finished(outcome)
    return outcome


class Forgiving:
    """Shows what it is called with; what cannot be shown is told once, and never ends the run."""

    def __init__(self, log: "logging.Logger | logging.LoggerAdapter[logging.Logger]") -> None:
        self._log, self._warned = log, False

    def __call__(self, show: Callable[[], object]) -> None:
        """Show something on the page of a run."""
        try:
            show()
        except Exception as error:  # a server away for a moment must not cost hours of work
            if not self._warned:
                self._warned = True
                why = safe_text(str(error).partition("\n")[0])
                self._log.warning("what this page shows is not complete (%s)", why)


class Watched:
    """The artifacts of one flow run."""

    def __init__(self, order: DatasetOrder) -> None:
        """Begin to show a run.

        Raises:
            TrilightError: TRILIGHT_USD_PER_CORE_HOUR is no price.
        """
        self._order = order
        self._price = usd_per_core_hour()
        self._folder = dataset_folder(order.place)
        self._began: float | None = None  # the first scene; objects are prepared before
        self._told = -_EVERY_S
        self._scenes = 0
        self._core_s = 0.0
        self._run: Run | None = None
        self._progress: UUID | None = None
        self._log = get_run_logger()
        self._shown = Forgiving(self._log)
        self._shown(self._begin)

    def task_done(self, run: Run, outcome: TaskOutcome) -> None:
        """Take a finished task into account, and tell it where the last table is old."""
        now = time.monotonic()
        if self._began is None and outcome.scenes:
            self._began = now - outcome.seconds
        self._run = run
        self._scenes += outcome.scenes
        self._core_s += outcome.core_s
        for shard in outcome.shards:
            self._log.info("shard %s: %d scenes", shard.name, shard.num_samples)
        if now - self._told >= _EVERY_S:
            self._told = now
            self._shown(lambda: self._tell(run))

    def finished(self, outcome: Outcome) -> None:
        """Tell the outcome, and how far everything is then."""
        if (run := self._run) is not None:
            self._shown(lambda: self._tell(run))
        self._shown(lambda: self._sum_up(outcome))
        done, planned = outcome.num_shards, outcome.num_shards_planned
        self._log.info("%d of %d shards are there; digest %s", done, planned, outcome.digest)

    def failed(self, error: Exception) -> None:
        """Tell why the run ended early; what it made is safe."""
        what = safe_text(f"{type(error).__name__}: {error}".partition("\n")[0])
        made = ("scenes of this run", str(self._scenes))
        self._shown(lambda: self._table("summary", [("failed", what), made]))

    def scenes_per_s(self) -> float:
        """Return the rate of this run since its first scene was begun; 0 before one is made."""
        return self._scenes / (time.monotonic() - self._began) if self._began is not None else 0.0

    def _begin(self) -> None:
        # Prefect's functions return coroutines only where an event loop runs
        self._progress = cast(
            UUID, create_progress_artifact(0.0, key="shards", description=self._order.place)
        )

    def _tell(self, run: Run) -> None:
        publication = run.publication
        of = publication.done
        done, planned = of.scenes, of.scenes_asked
        per_s = self.scenes_per_s()
        left = "unknown" if per_s == 0 else f"{(planned - done) / per_s / 60:.0f} minutes"
        self._percent(100.0 * done / planned)
        self._table(
            "progress",
            [
                ("shards", f"{of.shards} of {of.shards_asked}"),
                ("scenes in shards", f"{done - of.given_up} of {planned}"),
                ("views an hour", f"{3600 * per_s * publication.manifest.num_views:.0f}"),
                ("left, if nobody else helps", left),
            ],
        )

    def _sum_up(self, outcome: Outcome) -> None:
        done, planned = outcome.num_shards, outcome.num_shards_planned
        self._percent(100.0 * done / planned)
        rows = [("shards", f"{done} of {planned}"), ("dataset digest", outcome.digest)]
        rows += outcome.statistics.lines() if outcome.statistics else []
        if outcome.statistics is None:
            self._table("summary", rows)
            return
        # a page of Prefect's server cannot show files of the worker: it says where they are
        self._table("summary", [*rows, ("report", f"{self._order.place}/report.html")])
        if url := report_url(self._order.place):
            create_link_artifact(url, key="report", link_text="report")
        sheet = small_picture(self._folder.contact_sheet)
        create_image_artifact(sheet, key="contact-sheet", description=self._order.place)

    def _percent(self, percent: float) -> None:
        if self._progress is not None:
            update_progress_artifact(self._progress, percent)

    def _table(self, key: str, rows: Sequence[tuple[str, str]]) -> None:
        rejected = count_by_reason(read_failures(self._folder.failures))
        core_hours = self._core_s / 3600
        cost = f"{core_hours:.3f} core-hours, {core_hours * self._price:.2f} USD"
        everything = [
            *rows,
            *((f"rejected: {reason} ({stage})", str(count)) for stage, reason, count in rejected),
            ("cost of this run", cost),
        ]
        create_table_artifact(
            [{"what": name, "value": value} for name, value in everything],
            key,
            description=self._order.place,
        )


def usd_per_core_hour() -> float:
    """Return what an hour of a core costs.

    Raises:
        TrilightError: TRILIGHT_USD_PER_CORE_HOUR is no price.
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
    """Return where the report can be opened: below TRILIGHT_PUBLIC_URL, which shows datasets."""
    base = os.environ.get("TRILIGHT_PUBLIC_URL", "").rstrip("/")
    return f"{base}/{Path(out).name}/report.html" if base else None


def small_picture(path: Path) -> str:
    """Return a picture as a URL that holds it, at most _SHEET_PX wide and high."""
    stream = io.BytesIO()
    with Image.open(path) as picture:
        small = picture.convert("RGB")
    small.thumbnail((_SHEET_PX, _SHEET_PX))
    small.save(stream, "JPEG", quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"
