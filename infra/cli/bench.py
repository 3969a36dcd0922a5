"""`trilight bench`: lists the experiments, measures one, or shows its results."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from infra.bench_options import BenchOptions
from infra.cli.console import console, first_words, progress_bars
from infra.cli.options import command
from storage.errors import TrilightError
from storage.settings.described import checked

if TYPE_CHECKING:
    from infra.bench.experiment import Experiment
    from infra.bench.store import Run


@checked()
class BenchCommand:
    """The experiment, and the file of its results."""

    names: tuple[str, ...] = ()
    """Name of an experiment; by default all are listed and none is run."""
    quick: bool = False
    """Measure for minutes instead of hours: it shows that all works, and is nothing to quote."""
    out: Path | None = None
    """File for the results, with the plot beside it; by default docs/results/bench/NAME.jsonl of
    the checkout."""
    show: bool = False
    """Measure nothing: print the table of the newest finished run in the file."""


_COLUMNS = 8
"""Most columns of a table that stay readable side by side; further ones stand below."""


@command("names")
def bench(measured: BenchCommand, options: BenchOptions) -> None:
    try:
        from infra.bench.catalogue import experiment_of
        from infra.bench.experiment import FULL, QUICK
        from infra.bench.run import results_path, run
        from infra.bench.store import Store
    except ModuleNotFoundError as error:
        if ".bench" not in (error.name or ""):
            raise
        raise TrilightError(
            "bench: an installed Trilight has no experiments; expected a checkout. Clone the "
            "repository and run the command there."
        ) from error
    if not measured.names and not measured.show:
        _list_experiments()
        return
    if len(measured.names) != 1:
        number = len(measured.names)
        raise TrilightError(f"bench: {number} experiments named; expected one of `trilight bench`.")
    experiment = experiment_of(measured.names[0])
    scale = QUICK if measured.quick else FULL
    out = measured.out or results_path(experiment.name, scale)
    if measured.show:
        newest = Store(out).newest()
        if newest is None:
            raise TrilightError(f"{out}: it has no finished run; leave --show out to measure one.")
        _print_run(experiment, newest)
        return
    first_words(f"Measuring {experiment.name}: {experiment.title}")
    with progress_bars() as bars:
        task = bars.add_task("trials", total=None, note=experiment.name)
        found = run(
            experiment,
            scale,
            options,
            out,
            lambda done, total: bars.update(task, completed=done, total=total),
        )
    _print_run(experiment, found)
    console.print(f"Written: {out} and {out.with_suffix('.png').name}", style="bold")


def _print_run(experiment: "Experiment", run: "Run") -> None:
    from infra.bench.rows import table_of

    names, *lines = table_of(experiment, run)
    for first in range(1, len(names), _COLUMNS):
        shown = slice(first, first + _COLUMNS)
        title = experiment.title if first == 1 else "Further columns"
        table = Table(names[0], *names[shown], box=None, title=title, title_justify="left")
        for line in lines:
            table.add_row(Text(line[0]), *map(Text, line[shown]))
        console.print(table)
    machine = run.plan["machine"]
    measured_on = (machine.get("gpu"), machine["processor"], f"{machine['cores']} cores")
    notes = [
        experiment.because,
        *run.notes,
        *(
            f"{count} of {len(run.plan['trials'])} trials left out: {why}"
            for why, count in Counter(run.left_out.values()).items()
        ),
        f"{run.plan['scale']['name']}, {run.date}, {', '.join(filter(None, measured_on))}, "
        f"commit {machine['commit']}",
    ]
    for note in filter(None, notes):
        console.print(Text(note), soft_wrap=True)


def _list_experiments() -> None:
    from infra.bench.catalogue import every_experiment

    table = Table("experiment", "what it measures", box=None)
    for experiment in every_experiment().values():
        table.add_row(experiment.name, experiment.title)
    console.print(table)
