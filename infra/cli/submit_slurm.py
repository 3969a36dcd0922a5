"""`trilight submit slurm`: an array job of what is missing of a dataset."""

import shlex
from typing import Annotated

from infra.cli.console import console, first_words, next_step, note, print_json, print_rows
from pipeline.executors.slurm_array import ArrayJob, array_job, submit_array
from pipeline.making.dataset_order import DatasetOrder
from storage.dataset.progress import number_ranges
from storage.settings.described import checked
from storage.settings.ranges import Within

SLURM = "slurm"
"""Stands in the place of a flow."""


@checked()
class ArrayAsked:
    """With slurm: how the array is cut."""

    shards_per_task: Annotated[int | None, Within(1, 10**6, unit="shards")] = None
    """With slurm: number of shards of an array task; by default as few as 1000 tasks allow."""
    at_once: Annotated[int | None, Within(1, 10**6, unit="tasks")] = None
    """With slurm: maximum number of tasks that run at the same time; by default the cluster
    decides."""
    sbatch: tuple[str, ...] = ()
    """With slurm: further options of sbatch, such as --sbatch=--partition=cpu; by default there are
    none."""
    dry_run: bool = False
    """With slurm: print the command instead of submitting it."""


def submit_to_slurm(order: DatasetOrder, asked: ArrayAsked, *, as_json: bool) -> None:
    """Submit the missing shards of a dataset, and say what was submitted; raises TrilightError."""
    first_words(f"Looking for what is missing of {order.place}", silent=as_json)
    job = array_job(
        order, per_task=asked.shards_per_task, at_once=asked.at_once, options=asked.sbatch
    )
    if not job.tasks:
        _say_finished(order, as_json=as_json)
        return
    number = None if asked.dry_run else submit_array(job)
    if as_json:
        array = number_ranges(job.tasks)
        print_json({"job": number, "array": array, "shards_per_task": job.per_task})
        return
    rows = [
        ("tasks", f"{len(job.tasks)}: {number_ranges(job.tasks)}"),
        ("shards a task", str(job.per_task)),
        *([("job", number)] if number else []),
    ]
    print_rows("Would be submitted" if asked.dry_run else "Submitted", rows)
    if asked.dry_run:
        console.print(_line(job), soft_wrap=True, markup=False)
        return
    note("the same command submits again what is missing then, once no task is left in the queue")
    next_step(["status", order.place])


def _say_finished(order: DatasetOrder, *, as_json: bool) -> None:
    if as_json:
        print_json({"job": None, "array": "", "shards_per_task": None})
        return
    print_rows("Nothing is missing", [("dataset", order.place)])
    next_step(["verify", order.place])


def _line(job: ArrayJob) -> str:
    """Return the command for a shell; without the folder of their logs, Slurm fails all tasks."""
    settings = [f"{name}={shlex.quote(value)}" for name, value in job.environment.items()]
    return " ".join(["mkdir -p logs &&", *settings, shlex.join(job.command())])
