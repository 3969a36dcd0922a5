"""`trilight submit`: what `generate` does, by workers of a Prefect server or as an array."""

from pathlib import Path

from cyclopts import App

from infra.cli.changes import Shared
from infra.cli.console import first_words, next_step
from infra.cli.dataset_changes import with_shared
from infra.cli.flow_runs import FlowRuns, run_flow
from infra.cli.options import Shown, command
from infra.cli.submit_array import ARRAYS, ArrayAsked, submit_to_array
from pipeline.executors.array_job import DatasetByArray
from pipeline.executors.kubernetes_array import KubernetesOptions
from pipeline.flows.prefect_server import load_prefect
from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError
from storage.settings.described import checked

app = App(name="submit", usage="trilight submit FLOW BUILD [OPTIONS]")
BY_ARRAY = "make-by-array"
"""A flow that asks a scheduler, and shows what its tasks make."""
FLOWS = ("generate-scenes", "prepare-assets", "build-dataset")
"""Flows that take the options of `trilight generate`."""


@checked()
class Submission:
    """Who is to make it."""

    flow: str
    """Flow to run: generate-scenes, prepare-assets (objects alone) or build-dataset, or
    make-by-array, which has options of its own; or without any server, as an array of tasks for
    what is missing: slurm or kubernetes."""

    def __post_init__(self) -> None:
        if self.flow not in (*FLOWS, *ARRAYS):
            served = ", ".join((*FLOWS, BY_ARRAY))
            raise TrilightError(
                f"flow {self.flow!r} is unknown; expected one of {served}, or of "
                f"{', '.join(ARRAYS)}."
            )


@app.default
@command("flow", "build")
def submit(
    submission: Submission,
    runs: FlowRuns,
    order: DatasetOrder,
    shared: Shared,
    array: ArrayAsked,
    machines: KubernetesOptions,
    shown: Shown,
) -> None:
    if submission.flow in ARRAYS:
        order = with_shared(order, shared)
        submit_to_array(order, submission.flow, array, machines, as_json=shown.json)
        return
    if (array, machines) != (ArrayAsked(), KubernetesOptions()):
        raise TrilightError(
            f"submit {submission.flow}: --shards-per-task, --at-once, --dry-run and the options of "
            f"machines are those of submit {', '.join(ARRAYS)}; leave them out."
        )
    first_words(f"Submitting {submission.flow} with the build {order.build}", silent=shown.json)
    load_prefect()
    from pipeline.flows.submission import parameters

    given = parameters(with_shared(order, shared))
    ended = run_flow(submission.flow, given, runs, where=order.place, as_json=shown.json)
    if ended and not shown.json and Path(order.place).is_dir():
        next_step(["verify", order.place], ["inspect", order.place])


@app.command(
    name=BY_ARRAY,
    help="Have a worker of a Prefect server submit what is missing as an array; watch it there.",
)
@command("build")
def submit_by_array(order: DatasetByArray, shared: Shared, runs: FlowRuns, shown: Shown) -> None:
    first_words(f"Submitting {BY_ARRAY} with the build {order.build}", silent=shown.json)
    load_prefect()
    from pipeline.flows.submission import parameters

    given = parameters(with_shared(order, shared))
    ended = run_flow(BY_ARRAY, given, runs, where=order.place, as_json=shown.json)
    if ended and not shown.json and Path(order.place).is_dir():
        next_step(["verify", order.place], ["inspect", order.place])
