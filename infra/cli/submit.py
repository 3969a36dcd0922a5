"""`trilight submit`: runs `generate` by workers of a Prefect server, or as an array of tasks."""

import shlex
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group

from infra.cli.commands import HELP_FLAGS
from infra.cli.console import (
    Bars,
    console,
    first_words,
    next_step,
    note,
    print_json,
    print_rows,
)
from infra.cli.options import command
from infra.cli.overrides import BaseSettings, with_base_settings
from pipeline.executors.slurm_and_kubernetes import (
    DatasetByArray,
    KubernetesOptions,
    array_job,
    submit_job,
    submit_slurm_array,
)
from pipeline.flows.prefect_server import load_prefect
from pipeline.generation.generate_options import GenerateOptions
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from storage.remote.url import safe_text
from storage.settings.described import checked
from storage.settings.ranges import Within

app = App(
    name="submit",
    usage="trilight submit SCHEDULER PRESET [OPTIONS]",
    group_commands=Group("Schedulers"),
    help_epilogue="",
    help_flags=HELP_FLAGS,
)
BY_ARRAY = "make-by-array"
"""Flow that submits an array to a scheduler and shows the progress of its tasks."""
SLURM = "slurm"
KUBERNETES = "kubernetes"
FLOWS = ("generate-scenes", "prepare-assets", "build-dataset")
"""Flows that take the options of `trilight generate`."""


@checked()
class SubmitOptions:
    """Flow."""

    flow: str
    """Scheduler above, or a flow of a Prefect server: generate-scenes, prepare-assets,
    build-dataset."""

    def __post_init__(self) -> None:
        if self.flow not in FLOWS:
            known = ", ".join((SLURM, KUBERNETES, *FLOWS, BY_ARRAY))
            raise TrilightError(f"flow {self.flow!r} is unknown; expected one of {known}.")


@checked()
class FlowRunOptions:
    """Prefect server."""

    deployment: str | None = None
    """Name of the flow's deployment; by default local (make serve), or the only one."""
    no_watch: bool = False
    """Return once the server has the run, without watching it."""


@checked()
class ArrayOptions:
    """Array of tasks."""

    shards_per_task: Annotated[int | None, Within(1, 10**6, unit="shards")] = None
    """Number of shards of an array task; by default as few as 1000 tasks allow."""
    at_once: Annotated[int | None, Within(1, 10**6, unit="tasks")] = None
    """Maximum number of tasks at the same time; by default the cluster decides."""
    dry_run: bool = False
    """Write the files and print the commands, but submit nothing."""


@checked()
class SlurmOptions:
    """Slurm."""

    sbatch: tuple[str, ...] = ()
    """Further options of sbatch, such as --sbatch=--partition=cpu; by default none."""


@app.default
@command("flow", "build")
def submit(
    submission: SubmitOptions,
    runs: FlowRunOptions,
    options: GenerateOptions,
    base: BaseSettings,
) -> None:
    _submit_flow(submission.flow, options, base, runs)


@app.command(name=SLURM, help="Submit the missing shards to Slurm, as an array of tasks.")
@command("build")
def submit_to_slurm(
    options: GenerateOptions,
    base: BaseSettings,
    array: ArrayOptions,
    batch: SlurmOptions,
) -> None:
    submit_to_array(with_base_settings(options, base), array, batch)


@app.command(name=KUBERNETES, help="Submit the missing shards to Kubernetes, as an indexed job.")
@command("build")
def submit_to_kubernetes(
    options: GenerateOptions,
    base: BaseSettings,
    array: ArrayOptions,
    machines: KubernetesOptions,
) -> None:
    submit_to_array(with_base_settings(options, base), array, machines)


@app.command(name=BY_ARRAY, help="Have a Prefect worker submit the missing shards as an array.")
@command("build")
def submit_by_array(options: DatasetByArray, base: BaseSettings, runs: FlowRunOptions) -> None:
    _submit_flow(BY_ARRAY, options, base, runs)


def _submit_flow(
    flow: str,
    options: GenerateOptions,
    base: BaseSettings,
    runs: FlowRunOptions,
) -> None:
    """Submit a flow run; watch it to its end, report it and name the next commands.

    Raises:
        TrilightError: there is no such server or deployment, or the run failed.
    """
    first_words(f"Submitting {flow} with the preset {options.build}")
    load_prefect()
    from pipeline.flows import submission as prefect  # Prefect reads its settings at the import

    values = prefect.parameters(with_base_settings(options, base))
    with prefect.server() as client:
        deployment = prefect.find_deployment(client, flow, runs.deployment)
        name = f"{flow}/{deployment.name}"
        run = client.create_flow_run_from_deployment(deployment.id, parameters=values)
        page = prefect.page_of(client, run.id)
        console.print(f"Run {run.name} of {name}: {page}", soft_wrap=True)
        ends = f"prefect flow-run cancel {run.id} ends it"
        console.print(f"Ctrl-C here leaves it running; {ends}", soft_wrap=True)
        pool = deployment.work_pool_name or ""
        if not prefect.workers_online(client, pool):
            start = f"prefect worker start --pool {pool}"
            note(f"no worker of the pool {pool} is online, and the run waits for one: {start}")
        record: dict[str, Any] = {"flow_run": str(run.id), "deployment": name}
        if runs.no_watch:
            print_json(record)
            return
        state_name = ""
        with Bars() as bars:
            bar = bars.add_task("percent", total=100, note="")
            for state, percent, tables in prefect.poll_run(client, run.id):
                if state.name and state.name != state_name:
                    state_name = state.name
                    bars.console.print(state_name)
                scenes = tables.get("progress", {}).get("scenes in shards")
                text = f"scenes {scenes}" if scenes else ""
                bars.update(bar, completed=round(percent), note=text)
    summary = tables.get("summary", {})
    message = safe_text(state.message or "")
    print_json({**record, "state": state_name, "message": message, "summary": summary})
    if not state.is_completed():
        raise TrilightError(
            f"{name}: the run ended as {state_name}: {message.rstrip('.') or 'no reason given'}. "
            f"Its log is at {page}; the same command goes on with what is missing."
        )
    print_rows(f"{name} finished", [*summary.items(), ("where", options.place)])
    if Path(options.place).is_dir():
        next_step(["verify", options.place], ["inspect", options.place])


def submit_to_array(
    options: GenerateOptions,
    array: ArrayOptions,
    scheduler: SlurmOptions | KubernetesOptions,
) -> None:
    """Submit the missing shards of a dataset and print the job; raises TrilightError."""
    on = SLURM if isinstance(scheduler, SlurmOptions) else KUBERNETES
    first_words(f"Looking for what is missing of {options.place}")
    job = array_job(options, per_task=array.shards_per_task, at_once=array.at_once, on=on)
    if not job.tasks:
        print_json({"job": None, "array": "", "shards_per_task": None})
        print_rows("Nothing is missing", [("dataset", options.place)])
        next_step(["verify", options.place])
        return
    numbers = number_ranges(job.tasks)
    record: dict[str, Any] = {"array": numbers, "shards_per_task": job.per_task}
    name: str | None
    if isinstance(scheduler, SlurmOptions):
        name, line = submit_slurm_array(job, scheduler.sbatch, dry_run=array.dry_run)
    else:
        manifest, words = submit_job(job, scheduler, dry_run=array.dry_run)
        name = manifest.parent.name
        line = shlex.join(words)
        record |= {"files": [str(manifest)], "commands": [words], "submitted": not array.dry_run}
    print_json({"job": name, **record})
    rows = [("tasks", f"{len(job.tasks)}: {numbers}"), ("shards a task", str(job.per_task))]
    rows += [("job", name)] if name else []
    print_rows("Would be submitted" if array.dry_run else "Submitted", rows)
    if array.dry_run:
        console.print(line, soft_wrap=True)
        return
    note("the same command submits again what is missing then, once no task is left in the queue")
    next_step(["status", options.place])
