"""`trilight submit slurm` and `kubernetes`: submits the missing shards as an array of tasks."""

import shlex
from collections.abc import Sequence
from typing import Annotated

from infra.cli.console import console, first_words, next_step, note, print_json, print_rows
from pipeline.executors.array_job import ArrayJob, array_job
from pipeline.executors.kubernetes_array import (
    KubernetesOptions,
    create_command,
    submit_job,
    write_job_file,
)
from pipeline.executors.slurm_array import sbatch_command, sbatch_environment, submit_array
from pipeline.generation.dataset_order import DatasetOrder
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from storage.settings.described import checked
from storage.settings.ranges import Within

SLURM = "slurm"
ARRAYS = (SLURM, "kubernetes")
"""Schedulers that take an array of tasks."""


@checked()
class ArrayOptions:
    """Array (slurm or kubernetes)."""

    shards_per_task: Annotated[int | None, Within(1, 10**6, unit="shards")] = None
    """Number of shards of an array task; by default as few as 1000 tasks allow."""
    at_once: Annotated[int | None, Within(1, 10**6, unit="tasks")] = None
    """Maximum number of tasks at the same time; by default the cluster decides."""
    sbatch: tuple[str, ...] = ()
    """slurm: further options of sbatch, such as --sbatch=--partition=cpu; by default none."""
    dry_run: bool = False
    """Write the files and print the commands, but submit nothing."""


def submit_to_array(
    order: DatasetOrder, on: str, array: ArrayOptions, machines: KubernetesOptions, *, as_json: bool
) -> None:
    """Submit the missing shards of a dataset and print the job; raises TrilightError."""
    _refuse_foreign_options(on, array, machines)
    first_words(f"Looking for what is missing of {order.place}", silent=as_json)
    job = array_job(order, per_task=array.shards_per_task, at_once=array.at_once, on=on)
    if not job.tasks:
        _print_nothing_missing(order, as_json=as_json)
    elif on == SLURM:
        _submit_slurm(job, array, as_json=as_json)
    else:
        _submit_kubernetes(job, array, machines, as_json=as_json)


def _refuse_foreign_options(on: str, array: ArrayOptions, machines: KubernetesOptions) -> None:
    if on == SLURM and machines != KubernetesOptions():
        raise TrilightError(
            "submit slurm: --image, --where and the other options of machines are those of "
            "submit kubernetes; leave them out, and use --sbatch."
        )
    if on != SLURM and array.sbatch:
        raise TrilightError(f"submit {on}: --sbatch is an option of submit slurm; leave it out.")


def _submit_slurm(job: ArrayJob, array: ArrayOptions, *, as_json: bool) -> None:
    number = None if array.dry_run else submit_array(job, array.sbatch)
    if as_json:
        numbers = number_ranges(job.tasks)
        print_json({"job": number, "array": numbers, "shards_per_task": job.per_task})
        return
    _print_submitted(job, number, dry_run=array.dry_run)
    if array.dry_run:
        console.print(_slurm_line(job, array.sbatch), soft_wrap=True)
    else:
        _print_next(job)


def _submit_kubernetes(
    job: ArrayJob, array: ArrayOptions, options: KubernetesOptions, *, as_json: bool
) -> None:
    manifest = (write_job_file if array.dry_run else submit_job)(job, options)
    name = manifest.parent.name
    words = create_command(manifest)
    if as_json:
        print_json(
            {
                "job": name,
                "array": number_ranges(job.tasks),
                "shards_per_task": job.per_task,
                "files": [str(manifest)],
                "commands": [words],
                "submitted": not array.dry_run,
            }
        )
        return
    _print_submitted(job, name, dry_run=array.dry_run)
    if array.dry_run:
        console.print(shlex.join(words), soft_wrap=True)
    else:
        _print_next(job)


def _print_submitted(job: ArrayJob, name: str | None, *, dry_run: bool) -> None:
    rows = [
        ("tasks", f"{len(job.tasks)}: {number_ranges(job.tasks)}"),
        ("shards a task", str(job.per_task)),
        *([("job", name)] if name else []),
    ]
    print_rows("Would be submitted" if dry_run else "Submitted", rows)


def _print_next(job: ArrayJob) -> None:
    note("the same command submits again what is missing then, once no task is left in the queue")
    next_step(["status", job.order.place])


def _print_nothing_missing(order: DatasetOrder, *, as_json: bool) -> None:
    if as_json:
        print_json({"job": None, "array": "", "shards_per_task": None})
        return
    print_rows("Nothing is missing", [("dataset", order.place)])
    next_step(["verify", order.place])


def _slurm_line(job: ArrayJob, options: Sequence[str]) -> str:
    """Return the shell command; it makes the folder of the logs, without which all tasks fail."""
    variables = sbatch_environment(job).items()
    settings = [f"{name}={shlex.quote(value)}" for name, value in variables]
    return " ".join(["mkdir -p logs &&", *settings, shlex.join(sbatch_command(job, options))])
