"""`trilight submit`: what `generate` does, by workers of a Prefect server or as an array."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from infra.cli.changes import Shared
from infra.cli.console import (
    console,
    first_words,
    next_step,
    note,
    print_json,
    print_rows,
    progress_bars,
)
from infra.cli.dataset_changes import with_shared
from infra.cli.options import Shown, command
from infra.cli.submit_array import ARRAYS, ArrayAsked, submit_to_array
from pipeline.executors.arrays.machines import ArrayMachines
from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError
from storage.settings.described import checked

if TYPE_CHECKING:
    from pipeline.flows.submission import SeenRun, Submitted

FLOWS = ("generate-scenes", "prepare-assets", "build-dataset")
"""Flows that take the options of `trilight generate`."""


@checked()
class Submission:
    """Who is to make it."""

    flow: str
    """Flow to run: generate-scenes, prepare-assets (objects alone) or build-dataset; or without any
    server, as an array of tasks for what is missing: slurm, kubernetes, sky, aws-batch or
    google-batch."""
    deployment: str | None = None
    """Name of its deployment; by default local, which make serve makes, or the only one there
    is."""
    no_watch: bool = False
    """Return as soon as the server has the run, instead of watching it to its end."""

    def __post_init__(self) -> None:
        if self.flow not in (*FLOWS, *ARRAYS):
            raise TrilightError(
                f"flow {self.flow!r} is unknown; expected one of {', '.join(FLOWS)}, or of "
                f"{', '.join(ARRAYS)}."
            )


@command("flow", "build")
def submit(
    submission: Submission,
    order: DatasetOrder,
    shared: Shared,
    array: ArrayAsked,
    machines: ArrayMachines,
    shown: Shown,
) -> None:
    if submission.flow in ARRAYS:
        order = with_shared(order, shared)
        submit_to_array(order, submission.flow, array, machines, as_json=shown.json)
        return
    if (array, machines) != (ArrayAsked(), ArrayMachines()):
        raise TrilightError(
            f"submit {submission.flow}: --shards-per-task, --at-once, --dry-run and the options of "
            f"machines are those of submit {', '.join(ARRAYS)}; leave them out."
        )
    first_words(f"Submitting {submission.flow} with the build {order.build}", silent=shown.json)
    from pipeline.flows import submission as prefect  # reads its settings now

    given = prefect.parameters(with_shared(order, shared))
    with prefect.server() as client:
        run = prefect.submit(client, submission.flow, submission.deployment, given)
        if not shown.json:
            _say_where(run, prefect.workers_online(client, run.pool))
        if submission.no_watch:
            if shown.json:
                print_json({"flow_run": str(run.id), "deployment": run.deployment})
            return
        last = _watched(prefect.looks(client, run.id), silent=shown.json)
    _report(run, last, order, as_json=shown.json)


def _say_where(run: "Submitted", workers: int) -> None:
    console.print(f"Run {run.name} of {run.deployment}: {run.page}", soft_wrap=True)
    console.print(
        f"Ctrl-C here leaves it running; prefect flow-run cancel {run.id} ends it", soft_wrap=True
    )
    if not workers:
        start = f"prefect worker start --pool {run.pool}"
        note(f"no worker of the pool {run.pool} is online, and the run waits for one: {start}")


def _watched(looks: "Iterable[SeenRun]", *, silent: bool) -> "SeenRun":
    """Draw what is seen of a run, and return the last look."""
    last = None
    with progress_bars() as bars:
        bar = bars.add_task("percent", total=100, note="", visible=not silent)
        for look in looks:
            if not silent and (last is None or last.state != look.state):
                bars.console.print(look.state)
            scenes = dict(look.tables.get("progress", ())).get("scenes in shards")
            bars.update(
                bar, completed=round(look.percent), note=f"scenes {scenes}" if scenes else ""
            )
            last = look
    assert last is not None  # a run has at least one look
    return last


def _report(run: "Submitted", last: "SeenRun", order: DatasetOrder, *, as_json: bool) -> None:
    rows = last.tables.get("summary", ())
    if as_json:
        print_json(
            {
                "flow_run": str(run.id),
                "deployment": run.deployment,
                "state": last.state,
                "message": last.message,
                "summary": dict(rows),
            }
        )
    elif last.is_completed:
        print_rows(f"{run.deployment} finished", [*rows, ("where", order.place)])
    if not last.is_completed:
        reason = last.message or "no reason given"
        raise TrilightError(
            f"{run.deployment}: the run ended as {last.state}: {reason}. Its log is "
            f"at {run.page}; the same command goes on with what is missing."
        )
    if not as_json and Path(order.place).is_dir():
        next_step(["verify", order.place], ["inspect", order.place])
