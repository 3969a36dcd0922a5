"""Prefect flow `make-by-array`: submits a dataset to a scheduler's array and shows its progress.

Slurm or Kubernetes runs the tasks. The worker of this flow runs on a machine where `trilight submit
slurm` works; it renders nothing, reads the same files as `trilight status`, and may be killed:
another run shows the same. Image, machines and accounts are set on the worker (TRILIGHT_MACHINES,
TRILIGHT_IMAGE), since a person who may start a run must not choose what runs there.
"""

import time
from collections.abc import Sequence
from typing import Any

from prefect import flow
from prefect.logging import get_run_logger

from pipeline.executors.array_job import DatasetByArray, array_job
from pipeline.executors.kubernetes_array import options_from_environment, submit_job
from pipeline.executors.slurm_array import submit_slurm_array
from pipeline.flows.forms import DATASET_FORMS, options_of_form, parameters_of, run_name
from pipeline.flows.run_artifacts import ArtifactPage
from storage.dataset.progress import DatasetStatus, missing_shards, read_status
from storage.errors import TrilightError
from storage.number_ranges import number_ranges

LOOK_S = 20.0
"""Seconds between two looks at the dataset; in a bucket each lists some files."""


@flow(name="make-by-array", flow_run_name=run_name, persist_result=False)
@parameters_of(DatasetByArray, **DATASET_FORMS)
def make_by_array(**parameters: Any) -> None:
    """Submit the missing shards of a dataset to a scheduler, and show the progress until the end.

    Start it again when no task is left in the queue: it submits what is still missing.
    """
    options = options_of_form(parameters, DatasetByArray)
    artifacts = ArrayArtifacts(options.place)
    if options.scheduler != "none":
        _submit(options)
    artifacts.show_result(_watch_until_finished(options, artifacts))


def _submit(options: DatasetByArray) -> None:
    on = options.scheduler
    job = array_job(
        options.dataset, per_task=options.shards_per_task, at_once=options.at_once, on=on
    )
    if job.tasks:
        name = (
            submit_slurm_array(job)
            if on == "slurm"
            else submit_job(job, options_from_environment()).parent.name
        )
        get_run_logger().info(
            "%s has %s: tasks %s of %d shards", on, name, number_ranges(job.tasks), job.per_task
        )


def _watch_until_finished(options: DatasetByArray, artifacts: "ArrayArtifacts") -> DatasetStatus:
    """Show a dataset until it is finished; raises TrilightError after too long without scenes."""
    before = None
    changed_s = time.monotonic()
    while True:
        status = _status(options.place)
        if status and status.finished and not missing_shards(options.place, options.scenes or 0):
            return status  # a lost shard of a finished dataset is made again
        progress = (status.shards_done, status.scenes_done) if status else None
        if progress != before:
            before = progress
            changed_s = time.monotonic()
        if status is not None:
            artifacts.show_status(status)
        if time.monotonic() - changed_s > 3600 * options.quiet_hours:
            done = f"{status.scenes_done} of {status.scenes_planned}" if status else "none"
            raise TrilightError(
                f"{options.place}: no new scene for {options.quiet_hours:g} hours ({done} made); "
                "expected tasks at work. Look at the queue, and run the flow again: it submits "
                "what is missing."
            )
        time.sleep(LOOK_S)


def _status(location: str) -> DatasetStatus | None:
    """Return the status of a dataset; None before a task has begun it."""
    try:
        return read_status(location)
    except TrilightError:
        return None


class ArrayArtifacts(ArtifactPage):
    """The artifacts of a run that watches an array."""

    _rows: Sequence[tuple[str, str]] = ()

    def show_status(self, status: DatasetStatus) -> None:
        """Show the progress of the dataset, if it has changed."""
        remaining_s = status.remaining_s
        rows = [
            ("shards", f"{status.shards_done} of {status.shards_planned}"),
            ("scenes in shards", f"{status.scenes_done} of {status.scenes_planned}"),
            ("views an hour", _number(status.views_per_hour)),
            (
                "left at that rate",
                "unknown" if remaining_s is None else f"{remaining_s / 60:.0f} minutes",
            ),
            *_failures(status),
        ]
        if rows != self._rows:
            self._rows = rows
            self._show(lambda: self._tell(status, "progress", rows))

    def show_result(self, status: DatasetStatus) -> None:
        """Show the final counts, with the contact sheet if it is on this machine."""
        rows = [
            ("shards", f"{status.shards_done} of {status.shards_planned}"),
            ("dataset digest", status.digest),
            ("core hours", _number(status.core_hours)),
            *_failures(status),
        ]
        self._show(lambda: self._tell(status, "summary", rows))
        if not self._folder.bucket and self._folder.contact_sheet.exists():
            self._show(self._tell_sheet)

    def _tell(self, status: DatasetStatus, key: str, rows: Sequence[tuple[str, str]]) -> None:
        over = status.scenes_done + status.scenes_given_up
        self._tell_percent(100.0 * over / max(status.scenes_planned, 1))
        self._tell_table(key, rows)


def _failures(status: DatasetStatus) -> list[tuple[str, str]]:
    return [
        (f"rejected: {reason} ({stage})", str(count)) for stage, reason, count in status.failures
    ]


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.4g}"
