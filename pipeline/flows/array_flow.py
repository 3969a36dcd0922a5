"""The flow `make-by-array`: a scheduler makes the dataset, Prefect asks for it and shows it.

Slurm or Kubernetes runs the tasks. The worker of this flow stands where one would type `trilight
submit slurm`; it makes no picture, reads what `trilight status` reads, and may
be killed: another run shows the same. Image, machines and accounts are the worker's own
(TRILIGHT_MACHINES, TRILIGHT_IMAGE), since who may start a run must not choose what runs there.
"""

import time
from typing import Any, cast
from uuid import UUID

from prefect import flow
from prefect.artifacts import (
    create_image_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.logging import get_run_logger

from pipeline.executors.array_job import DatasetByArray, array_job
from pipeline.executors.kubernetes_array import options_here, submit_job
from pipeline.executors.slurm_array import submit_array
from pipeline.flows.forms import parameters_of
from pipeline.flows.orders import DATASET_FORMS, order_of, run_name
from pipeline.flows.watching import Forgiving, small_picture
from storage.dataset.layout import dataset_folder
from storage.dataset.progress import DatasetStatus, missing_shards, read_status
from storage.errors import TrilightError
from storage.number_ranges import number_ranges

LOOK_S = 20.0
"""Between two looks at the dataset; in a bucket each lists some files."""


@flow(name="make-by-array", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetByArray, **DATASET_FORMS)
def make_by_array(**parameters: Any) -> None:
    """Ask a scheduler for what is missing of a dataset, and show how far it is until it is there.

    Start it again when no task is left in the queue: it asks for what is still missing.
    """
    order = order_of(parameters, DatasetByArray)
    shown = ShownArray(order.place)
    if order.scheduler != "none":
        _submit(order)
    shown.finished(_watched(order, shown))


def _submit(order: DatasetByArray) -> None:
    on = order.scheduler
    job = array_job(order.dataset, per_task=order.shards_per_task, at_once=order.at_once, on=on)
    if job.tasks:
        name = submit_array(job) if on == "slurm" else submit_job(job, options_here()).parent.name
        get_run_logger().info(
            "%s has %s: tasks %s of %d shards", on, name, number_ranges(job.tasks), job.per_task
        )


def _watched(order: DatasetByArray, shown: "ShownArray") -> DatasetStatus:
    """Show a dataset until it is finished; raises TrilightError where nothing comes for long."""
    before, changed_s = None, time.monotonic()
    while True:
        status = _status(order.place)
        if status and status.finished and not missing_shards(order.place, order.scenes or 0):
            return status  # a shard of a finished dataset may be gone, and made anew
        there = (status.shards_done, status.scenes_done) if status else None
        if there != before:
            before, changed_s = there, time.monotonic()
        if status is not None:
            shown.tell(status)
        if time.monotonic() - changed_s > 3600 * order.quiet_hours:
            done = f"{status.scenes_done} of {status.scenes_planned}" if status else "none"
            raise TrilightError(
                f"{order.place}: no new scene for {order.quiet_hours:g} hours ({done} made); "
                "expected tasks at work. Look at the queue, and run the flow again: it asks for "
                "what is missing."
            )
        time.sleep(LOOK_S)


def _status(place: str) -> DatasetStatus | None:
    """Return the status of a dataset; None before a task has begun it."""
    try:
        return read_status(place)
    except TrilightError:
        return None


class ShownArray:
    """The artifacts of a run; one that cannot be shown does not end it."""

    def __init__(self, place: str) -> None:
        self._place = place
        self._shown = Forgiving(get_run_logger())
        self._rows: list[tuple[str, str]] = []
        self._progress: UUID | None = None
        self._shown(self._begin)

    def tell(self, status: DatasetStatus) -> None:
        """Tell how far the dataset is, where that has changed."""
        left = status.remaining_s
        rows = [
            ("shards", f"{status.shards_done} of {status.shards_planned}"),
            ("scenes in shards", f"{status.scenes_done} of {status.scenes_planned}"),
            ("views an hour", _number(status.views_per_hour)),
            ("left at that rate", "unknown" if left is None else f"{left / 60:.0f} minutes"),
            *_failures(status),
        ]
        if rows != self._rows:
            self._rows = rows
            self._shown(lambda: self._tell(status, "progress", rows))

    def finished(self, status: DatasetStatus) -> None:
        """Tell the outcome, with the picture of scenes where they are on this machine."""
        rows = [
            ("shards", f"{status.shards_done} of {status.shards_planned}"),
            ("dataset digest", status.digest),
            ("core hours", _number(status.core_hours)),
            *_failures(status),
        ]
        self._shown(lambda: self._tell(status, "summary", rows))
        folder = dataset_folder(self._place)
        if not folder.bucket and folder.contact_sheet.exists():
            sheet = small_picture(folder.contact_sheet)
            self._shown(lambda: self._picture(sheet))

    def _begin(self) -> None:
        self._progress = cast(
            UUID, create_progress_artifact(0.0, key="shards", description=self._place)
        )

    def _tell(self, status: DatasetStatus, key: str, rows: list[tuple[str, str]]) -> None:
        if self._progress is not None:
            over = status.scenes_done + status.scenes_given_up
            percent = 100.0 * over / max(status.scenes_planned, 1)
            update_progress_artifact(self._progress, percent)
        table = [{"what": name, "value": value} for name, value in rows]
        create_table_artifact(table, key, description=self._place)

    def _picture(self, sheet: str) -> None:
        create_image_artifact(sheet, key="contact-sheet", description=self._place)


def _failures(status: DatasetStatus) -> list[tuple[str, str]]:
    return [
        (f"rejected: {reason} ({stage})", str(count)) for stage, reason, count in status.failures
    ]


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"
