"""`trilight bench`: lists the experiments, runs one, or prints its results."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from infra.bench_options import BenchOptions
from infra.cli.console import console, first_words, progress
from infra.cli.options import command
from storage.errors import TrilightError
from storage.settings.described import checked

if TYPE_CHECKING:
    from infra.bench.experiment import Experiment, Run


@checked()
class BenchRunOptions:
    """Experiment and results."""

    names: tuple[str, ...] = ()
    """Name of an experiment; by default all are listed and none is run."""
    quick: bool = False
    """Measure for minutes, not hours: a check, with no figures to quote."""
    out: Path | None = None
    """File for the results, with the plot beside it; by default docs/results/bench/NAME.jsonl of
    the checkout."""
    show: bool = False
    """Print the newest finished run of the file, and measure nothing."""


_COLUMNS = 8
"""Maximum number of columns side by side; further ones are printed below."""


@command("names", has_json=False)
def bench(run_options: BenchRunOptions, options: BenchOptions) -> None:
    try:
        from infra.bench.experiment import (
            FULL,
            QUICK,
            every_experiment,
            experiment_of,
            read_runs,
        )
        from infra.bench.run_benchmark import results_path, run
    except ModuleNotFoundError as error:
        if ".bench" not in (error.name or ""):
            raise
        raise TrilightError(
            "bench: an installed Trilight has no experiments; expected a checkout. Clone the "
            "repository and run the command there."
        ) from error
    if not run_options.names and not run_options.show:
        table = Table("experiment", "what it measures", box=None)
        for each in every_experiment().values():
            table.add_row(each.name, each.title)
        console.print(table)
        return
    if len(run_options.names) != 1:
        number = len(run_options.names)
        raise TrilightError(f"bench: {number} experiments named; expected one of `trilight bench`.")
    experiment = experiment_of(run_options.names[0])
    scale = QUICK if run_options.quick else FULL
    out = run_options.out or results_path(experiment.name, scale)
    if run_options.show:
        finished = [each for each in read_runs(out) if each.seconds is not None]
        if not finished:
            raise TrilightError(f"{out}: it has no finished run; leave --show out to measure one.")
        _print_run(experiment, finished[-1])
        return
    first_words(f"Measuring {experiment.name}: {experiment.title}")
    with progress("trials") as on_trial:
        result = run(experiment, scale, options, out, on_trial)
    _print_run(experiment, result)
    console.print(f"Written: {out} and {out.with_suffix('.png').name}", style="bold")


def _print_run(experiment: "Experiment", run: "Run") -> None:
    from infra.bench.rows import table_of

    names, *lines = table_of(experiment, run)
    for first in range(1, len(names), _COLUMNS):
        columns = slice(first, first + _COLUMNS)
        title = experiment.title if first == 1 else "Further columns"
        table = Table(names[0], *names[columns], box=None, title=title, title_justify="left")
        for line in lines:
            table.add_row(Text(line[0]), *map(Text, line[columns]))
        console.print(table)
    machine = run.plan["machine"]
    measured_on = [str(machine[name]) for name in ("gpu", "processor") if name in machine]
    if "cores" in machine:
        measured_on += [f"{machine['cores']} cores", f"commit {machine['commit']}"]
    notes = [
        experiment.because,
        *run.notes,
        *(
            f"{count} of {len(run.plan['trials'])} trials left out: {why}"
            for why, count in Counter(run.left_out.values()).items()
        ),
        ", ".join([run.plan["scale"]["name"], run.date, *measured_on]),
    ]
    for note in filter(None, notes):
        console.print(Text(note), soft_wrap=True)
