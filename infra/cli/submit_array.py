"""`trilight submit slurm`, `kubernetes`, `sky`, `aws-batch`, `google-batch`: what is missing."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from infra.cli.console import console, first_words, next_step, note, print_json, print_rows
from pipeline.executors.arrays.form import submit_form
from pipeline.executors.arrays.forms import FORMS
from pipeline.executors.arrays.job import ArrayJob, array_job
from pipeline.executors.arrays.machines import ArrayMachines
from pipeline.executors.arrays.submission import SLURM, submitted
from pipeline.executors.slurm_array import sbatch_environment, sbatch_words
from pipeline.making.dataset_order import DatasetOrder
from storage.errors import TrilightError
from storage.number_ranges import number_ranges
from storage.settings.described import checked
from storage.settings.ranges import Within


@checked()
class ArrayAsked:
    """With slurm, kubernetes, sky, aws-batch or google-batch: how the array is cut."""

    shards_per_task: Annotated[int | None, Within(1, 10**6, unit="shards")] = None
    """Number of shards of an array task; by default as few as 1000 tasks allow."""
    at_once: Annotated[int | None, Within(1, 10**6, unit="tasks")] = None
    """Maximum number of tasks that run at the same time; by default the cluster or queue decides,
    and with sky and google-batch, which pay for every machine, it must be given."""
    sbatch: tuple[str, ...] = ()
    """With slurm: further options of sbatch, such as --sbatch=--partition=cpu; by default there are
    none."""
    dry_run: bool = False
    """Print the commands instead of submitting; files that they name are written."""


def submit_to_array(
    order: DatasetOrder, on: str, asked: ArrayAsked, machines: ArrayMachines, *, as_json: bool
) -> None:
    """Submit the missing shards of a dataset, and say what was submitted; raises TrilightError."""
    _refuse_of_others(on, asked, machines)
    first_words(f"Looking for what is missing of {order.place}", silent=as_json)
    job = array_job(order, per_task=asked.shards_per_task, at_once=asked.at_once, on=on)
    if not job.tasks:
        _say_finished(order, as_json=as_json)
    elif on == SLURM:
        _submit_slurm(job, asked, as_json=as_json)
    else:
        _submit_form(job, on, asked, machines, as_json=as_json)


def _refuse_of_others(on: str, asked: ArrayAsked, machines: ArrayMachines) -> None:
    if on == SLURM and machines != ArrayMachines():
        raise TrilightError(
            "submit slurm: --image, --where and the other options of machines are those of "
            f"{', '.join(FORMS)}; leave them out, and use --sbatch."
        )
    if on != SLURM and asked.sbatch:
        raise TrilightError(f"submit {on}: --sbatch is an option of submit slurm; leave it out.")


def _submit_slurm(job: ArrayJob, asked: ArrayAsked, *, as_json: bool) -> None:
    number = None if asked.dry_run else submitted(job, SLURM, ArrayMachines(), asked.sbatch)
    if as_json:
        array = number_ranges(job.tasks)
        print_json({"job": number, "array": array, "shards_per_task": job.per_task})
        return
    _say(job, number, dry_run=asked.dry_run)
    if asked.dry_run:
        console.print(_slurm_line(job, asked.sbatch), soft_wrap=True, markup=False)
    else:
        _say_how_to_go_on(job)


def _submit_form(
    job: ArrayJob, on: str, asked: ArrayAsked, machines: ArrayMachines, *, as_json: bool
) -> None:
    form = FORMS[on](job, machines)
    commands = form.written(Path(machines.files))
    if not asked.dry_run:
        submit_form(commands, on)
    if as_json:
        print_json(
            {
                "job": form.name,
                "array": number_ranges(job.tasks),
                "shards_per_task": job.per_task,
                "files": [str(Path(machines.files) / form.name / file) for file in form.files],
                "commands": commands,
                "afterwards": form.afterwards,
                "submitted": not asked.dry_run,
            }
        )
        return
    _say(job, form.name, dry_run=asked.dry_run)
    if asked.dry_run:
        _print_commands(commands)
    if form.afterwards:
        note("machines of the pool cost money until this is run, after the last task")
        _print_commands(form.afterwards)
    if not asked.dry_run:
        _say_how_to_go_on(job)


def _say(job: ArrayJob, name: str | None, *, dry_run: bool) -> None:
    rows = [
        ("tasks", f"{len(job.tasks)}: {number_ranges(job.tasks)}"),
        ("shards a task", str(job.per_task)),
        *([("job", name)] if name else []),
    ]
    print_rows("Would be submitted" if dry_run else "Submitted", rows)


def _say_how_to_go_on(job: ArrayJob) -> None:
    note("the same command submits again what is missing then, once no task is left in the queue")
    next_step(["status", job.order.place])


def _print_commands(commands: Sequence[Sequence[str]]) -> None:
    for command in commands:
        console.print(shlex.join(command), soft_wrap=True, markup=False)


def _say_finished(order: DatasetOrder, *, as_json: bool) -> None:
    if as_json:
        print_json({"job": None, "array": "", "shards_per_task": None})
        return
    print_rows("Nothing is missing", [("dataset", order.place)])
    next_step(["verify", order.place])


def _slurm_line(job: ArrayJob, options: Sequence[str]) -> str:
    """Return the command for a shell; without the folder of their logs, Slurm fails all tasks."""
    variables = sbatch_environment(job).items()
    settings = [f"{name}={shlex.quote(value)}" for name, value in variables]
    return " ".join(["mkdir -p logs &&", *settings, shlex.join(sbatch_words(job, options))])
