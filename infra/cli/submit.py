"""`trilight submit`: runs `generate` by workers of a Prefect server, or as an array of tasks."""

from pathlib import Path

from cyclopts import App

from infra.cli.changes import BaseSettings, with_base_settings
from infra.cli.console import first_words, next_step
from infra.cli.flow_runs import FlowRunOptions, run_flow
from infra.cli.options import OutputOptions, command
from infra.cli.submit_array import ARRAYS, ArrayOptions, submit_to_array
from pipeline.executors.array_job import DatasetByArray
from pipeline.executors.kubernetes_array import KubernetesOptions
from pipeline.flows.prefect_server import load_prefect
from pipeline.generation.dataset_order import DatasetOrder
from storage.errors import TrilightError
from storage.settings.described import checked

app = App(name="submit", usage="trilight submit FLOW BUILD [OPTIONS]")
BY_ARRAY = "make-by-array"
"""Flow that submits an array to a scheduler and shows the progress of its tasks."""
FLOWS = ("generate-scenes", "prepare-assets", "build-dataset")
"""Flows that take the options of `trilight generate`."""


@checked()
class SubmitOptions:
    """Flow or scheduler."""

    flow: str
    """Flow: generate-scenes, prepare-assets, build-dataset or make-by-array; or slurm, or
    kubernetes. The last two need no server, and submit the missing shards as an array."""

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
    submission: SubmitOptions,
    runs: FlowRunOptions,
    order: DatasetOrder,
    base: BaseSettings,
    array: ArrayOptions,
    machines: KubernetesOptions,
    output: OutputOptions,
) -> None:
    if submission.flow in ARRAYS:
        order = with_base_settings(order, base)
        submit_to_array(order, submission.flow, array, machines, as_json=output.json)
        return
    if (array, machines) != (ArrayOptions(), KubernetesOptions()):
        raise TrilightError(
            f"submit {submission.flow}: --shards-per-task, --at-once, --dry-run and the options of "
            f"machines are those of submit {', '.join(ARRAYS)}; leave them out."
        )
    _submit_flow(submission.flow, order, base, runs, output)


@app.command(
    name=BY_ARRAY,
    help="Have a Prefect worker submit the missing shards as an array.",
)
@command("build")
def submit_by_array(
    order: DatasetByArray, base: BaseSettings, runs: FlowRunOptions, output: OutputOptions
) -> None:
    _submit_flow(BY_ARRAY, order, base, runs, output)


def _submit_flow(
    flow: str, order: DatasetOrder, base: BaseSettings, runs: FlowRunOptions, output: OutputOptions
) -> None:
    """Submit a flow run and report it; once it has ended, name the next commands."""
    first_words(f"Submitting {flow} with the build {order.build}", silent=output.json)
    load_prefect()
    from pipeline.flows.submission import parameters

    values = parameters(with_base_settings(order, base))
    ended = run_flow(flow, values, runs, where=order.place, as_json=output.json)
    if ended and not output.json and Path(order.place).is_dir():
        next_step(["verify", order.place], ["inspect", order.place])
