"""`trilight bench`: lists the experiments, runs some, or writes the pages made from results."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from infra.bench.effort import Asked
from infra.cli.bench_card import ABOUT, bench_card
from infra.cli.bench_card import NAME as CARD
from infra.cli.console import console, first_words, progress_bars
from infra.cli.options import command
from storage.settings.described import checked

if TYPE_CHECKING:
    from infra.bench.experiment import Experiment
    from infra.bench.store import Store


@checked()
class Measured:
    """The experiments, and where results go."""

    names: tuple[str, ...] = ()
    """Names of experiments or of families of them; by default all are listed and none is run. The
    name card measures the graphics card here into one file to send back, card RUN ... only the
    steps of these runs, and card FILE ... shows such files."""
    share: str | None = None
    """Measure only a share of the rows, K/N for the K-th of N, into a file of its own beside the
    results; without one, a later call takes all such files over and measures what they lack. For
    experiments of days, such as learning-rates: one share for each task of a Slurm array, or for
    each of some processes on one card. Points that are compared in turns stay together. By default
    everything is measured."""
    quick: bool = False
    """Measure for minutes instead of carefully."""
    out: Path | None = None
    """Folder for the results; by default docs/bench of the checkout. Of card: the file, by default
    trilight-card.json."""
    write_docs: bool = False
    """Afterwards write the blocks of README.md and docs that are made from the results."""


@command("names")
def bench(measured: Measured, asked: Asked) -> None:
    if measured.names[:1] == (CARD,):
        bench_card(measured.names[1:], measured.out, asked, write_docs=measured.write_docs)
        return
    if measured.names:
        first_words(f"Measuring {', '.join(measured.names)}")
    from infra.bench.catalogue import chosen
    from infra.bench.effort import CAREFUL, QUICK
    from infra.bench.run import RESULTS, lacking, run, run_share
    from infra.bench.shares import share_of

    folder, experiments = measured.out or RESULTS, chosen(measured.names)
    share = None if measured.share is None else share_of(measured.share)
    effort = QUICK if measured.quick else CAREFUL
    for experiment in experiments:
        if (lack := lacking(experiment, asked)) and len(experiments) > 1:
            console.print(f"{experiment.name}: left out: {lack}")
            continue
        with progress_bars() as bars:
            task = bars.add_task("turns", total=None, note=experiment.name)
            measure = run if share is None else partial(run_share, share=share)
            store = measure(
                experiment,
                effort,
                asked,
                folder=folder,
                turn_done=lambda done, total: bars.update(task, completed=done, total=total),  # noqa: B023
            )
        if share is None:
            _print(experiment, store)
        else:
            console.print(f"Written: {store.path}", style="bold")
    if measured.write_docs:
        _write_docs(folder)
    elif not measured.names:
        _list()


def _print(experiment: "Experiment", store: "Store") -> None:
    from infra.bench.table import printed

    found = store.newest()
    assert found is not None
    names, *lines = printed(experiment, found)
    table = Table(*names, box=None, title=experiment.title)
    for line in lines:
        table.add_row(*line)
    console.print(table)
    for note in (
        *found.notes,
        *(f"{turn} left out: {why}" for turn, why in found.left_out.items()),
    ):
        console.print(note, soft_wrap=True)
    console.print(f"Written: {store.path} and {store.path.stem}.png", style="bold")


def _write_docs(folder: Path) -> None:
    from infra.bench.pages import write_pages

    for page in write_pages(folder):
        console.print(f"Written: {page}, and its figures", style="bold")


def _list() -> None:
    from infra.bench.catalogue import families

    table = Table("family", "experiment", "what it measures", box=None)
    for family, experiments in families().items():
        for experiment in experiments:
            table.add_row(family, experiment.name, experiment.title)
    table.add_row("", CARD, ABOUT)
    console.print(table)
