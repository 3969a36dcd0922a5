"""`trilight bench`: lists the experiments, runs some, or writes the pages made from results."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from infra.cli.console import console, first_words, progress_bars
from pipeline.objects.licences import DEFAULT_ALLOWED

if TYPE_CHECKING:
    from infra.bench.experiment import Experiment
    from infra.bench.store import Run


def bench(
    names: Annotated[
        list[str] | None, typer.Argument(help="experiments or families of them [lists all]")
    ] = None,
    quick: Annotated[bool, typer.Option(help="minutes instead of a careful measurement")] = False,
    objects: Annotated[
        list[str] | None, typer.Option(help="source of objects; may be repeated [builtin:]")
    ] = None,
    allow_licence: Annotated[
        list[str] | None, typer.Option(help="measure objects under this licence too")
    ] = None,
    scenes: Annotated[
        Path | None, typer.Option(help="folder of RenderFormer scenes to render as well")
    ] = None,
    checkpoint: Annotated[
        str, typer.Option(help="network to measure [the shipped one]")
    ] = "builtin:",
    data: Annotated[str, typer.Option(help="root of a finished dataset, for economy")] = "",
    out: Annotated[Path | None, typer.Option(help="folder of the results [docs/bench]")] = None,
    write_docs: Annotated[
        bool, typer.Option(help="then write the blocks of README.md and docs from all results")
    ] = False,
) -> None:
    """Measure cost against error; a run that was interrupted goes on where it was."""
    if names:
        first_words(f"Measuring {', '.join(names)}")
    from infra.bench.asked import Asked
    from infra.bench.catalogue import chosen
    from infra.bench.effort import CAREFUL, QUICK
    from infra.bench.run import RESULTS, lacking, run

    asked = Asked(
        objects=tuple(objects or ("builtin:",)),
        allowed_licences=(*DEFAULT_ALLOWED, *(allow_licence or ())),
        scenes=scenes,
        checkpoint=checkpoint,
        data=data,
    )
    folder, experiments = out or RESULTS, chosen(names or [])
    for experiment in experiments:
        if (lack := lacking(experiment, asked)) and len(experiments) > 1:
            console.print(f"{experiment.name}: left out: {lack}")
            continue
        with progress_bars() as bars:
            task = bars.add_task(experiment.name, total=None, note="")
            store = run(
                experiment,
                QUICK if quick else CAREFUL,
                asked,
                folder=folder,
                turn_done=lambda done, total: bars.update(task, completed=done, total=total),  # noqa: B023
            )
        found = store.newest()
        assert found is not None
        _print(experiment, found)
        console.print(f"Written: {store.path} and {store.path.stem}.png", style="bold")
    if write_docs:
        _write_docs(folder)
    elif not names:
        _list()


def _print(experiment: "Experiment", found: "Run") -> None:
    from infra.bench.table import cells, headings

    table = Table(*headings(experiment), box=None, title=experiment.title)
    for row in cells(experiment, found, spread=True):
        table.add_row(*row)
    console.print(table)
    _notes([*found.notes, *(f"{turn} left out: {why}" for turn, why in found.left_out.items())])


def _notes(notes: Sequence[str]) -> None:
    for note in notes:
        console.print(note, soft_wrap=True)


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
    console.print(table)
