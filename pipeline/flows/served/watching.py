"""What people watch on Prefect's page: progress, a table, a link, a summary.

It shows what the files say (`trilight status` says the same); nothing is decided by it.
"""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import cast
from uuid import UUID

from prefect.artifacts import (
    create_link_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.logging import get_run_logger

from pipeline.flows.dataset_run import Outcome, Run
from pipeline.flows.make_task import TaskOutcome
from pipeline.flows.order import DatasetOrder
from storage.failures import count_by_reason, read_failures
from storage.output import dataset_folder

USD_PER_CORE_HOUR = 0.04
"""What TRILIGHT_USD_PER_CORE_HOUR says otherwise."""
_EVERY_S = 15.0
"""Between two tables; each is a row of Prefect's database."""


class Watched:
    """The artifacts of one flow run."""

    def __init__(self, order: DatasetOrder) -> None:
        self._order = order
        self._folder = dataset_folder(order.out)
        self._started = time.monotonic()
        self._told = -_EVERY_S
        self._scenes = 0
        self._core_s = 0.0
        # Prefect's functions return coroutines only where an event loop runs
        self._progress = cast(
            UUID, create_progress_artifact(0.0, key="shards", description=order.out)
        )
        self._log = get_run_logger()

    def task_done(self, run: Run, outcome: TaskOutcome) -> None:
        """Take a finished task into account, and tell it where the last table is old."""
        self._scenes += outcome.scenes
        self._core_s += outcome.core_s
        for shard in outcome.shards:
            self._log.info("shard %s: %d scenes", shard.name, shard.num_samples)
        if time.monotonic() - self._told < _EVERY_S:
            return
        self._told = time.monotonic()
        publication = run.publication
        done = publication.num_scenes_finished()
        planned = publication.manifest.num_scenes
        per_s = self._scenes / (time.monotonic() - self._started)
        left = "unknown" if per_s == 0 else f"{(planned - done) / per_s / 60:.0f} minutes"
        update_progress_artifact(self._progress, 100.0 * done / planned)
        self._table(
            "progress",
            [
                ("shards", f"{publication.num_shards_finished()} of {publication.num_shards}"),
                ("scenes in shards", f"{done} of {planned}"),
                ("views an hour", f"{3600 * per_s * publication.manifest.num_views:.0f}"),
                ("left, if nobody else helps", left),
            ],
        )

    def finished(self, outcome: Outcome) -> None:
        """Tell the outcome."""
        done, planned = outcome.num_shards, outcome.num_shards_planned
        update_progress_artifact(self._progress, 100.0 * done / planned)
        rows = [("shards", f"{done} of {planned}"), ("dataset digest", outcome.digest)]
        rows += outcome.statistics.lines() if outcome.statistics else []
        self._table("summary", rows)
        if outcome.statistics:
            create_link_artifact(_report_url(self._order.out), key="report", link_text="report")
        self._log.info("%d of %d shards are there; digest %s", done, planned, outcome.digest)

    def _table(self, key: str, rows: Sequence[tuple[str, str]]) -> None:
        rejected = count_by_reason(read_failures(self._folder.failures))
        price = float(os.environ.get("TRILIGHT_USD_PER_CORE_HOUR", USD_PER_CORE_HOUR))
        core_hours = self._core_s / 3600
        cost = f"{core_hours:.3f} core-hours, {core_hours * price:.2f} USD"
        everything = [
            *rows,
            *((f"rejected: {reason} ({stage})", str(count)) for stage, reason, count in rejected),
            ("cost of this run", cost),
        ]
        create_table_artifact([{"what": name, "value": value} for name, value in everything], key)


def _report_url(out: str) -> str:
    """Return where the report page is: below TRILIGHT_PUBLIC_URL where a server shows datasets."""
    base = os.environ.get("TRILIGHT_PUBLIC_URL", "").rstrip("/")
    place = f"{Path(out).name if base else out}/report.html"
    return f"{base}/{place}" if base else place
