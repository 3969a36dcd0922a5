"""`trilight bench`: one benchmark, its figures, and a dated result."""

from typing import Annotated

import typer

from infra.cli.console import console, print_rows, progress_bars
from storage.errors import TrilightError

_NAMES = ("render",)


def bench(
    name: Annotated[str, typer.Argument(help=f"one of: {', '.join(_NAMES)}")],
    quick: Annotated[bool, typer.Option(help="minutes instead of a careful measurement")] = False,
) -> None:
    """Run a benchmark; writes a dated JSON line and a figure under docs/bench."""
    if name not in _NAMES:
        raise TrilightError(f"benchmark {name!r} is unknown; expected one of {', '.join(_NAMES)}.")
    from infra.bench import render
    from infra.bench.harness import save

    with progress_bars() as bars:
        task = bars.add_task("rounds", total=render.num_rounds(quick=quick), note="")
        result = render.run(quick=quick, round_done=lambda: bars.advance(task))
    path = save(result, quick=quick)
    figure = path.with_suffix(".png")
    render.plot(result, figure)
    print_rows(f"{name} on {result.machine['processor']}", render.rows(result))
    console.print(result.as_json_line(), soft_wrap=True)
    console.print(f"\nWritten: {path} and {figure.name}", style="bold")
