"""`trilight bench`: one benchmark, its figures, and a dated result."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from infra.cli.console import console, print_rows, progress_bars
from pipeline.objects.licences import DEFAULT_ALLOWED
from storage.errors import TrilightError

if TYPE_CHECKING:
    from infra.bench.harness import Comparison, Options

_NAMES = ("assets", "render", "scenes", "shards")


@dataclass(frozen=True, kw_only=True)
class _Benchmark:
    num_rounds: "Callable[[Options], int]"
    run: "Callable[[Options, Callable[[], None]], Comparison]"
    rows: "Callable[[Comparison], list[tuple[str, str]]]"
    plot: "Callable[[Comparison, Path], None]"


def bench(
    name: Annotated[str, typer.Argument(help=f"one of: {', '.join(_NAMES)}")],
    quick: Annotated[bool, typer.Option(help="minutes instead of a careful measurement")] = False,
    objects: Annotated[
        list[str] | None, typer.Option(help="source of objects; may be repeated [builtin:]")
    ] = None,
    allow_licence: Annotated[
        list[str] | None, typer.Option(help="measure objects under this licence too")
    ] = None,
) -> None:
    """Run a benchmark; writes a dated JSON line and a figure under docs/bench."""
    benchmark = _named(name)
    from infra.bench.harness import Options, save

    options = Options(
        quick=quick,
        objects=tuple(objects or ("builtin:",)),
        allowed_licences=(*DEFAULT_ALLOWED, *(allow_licence or ())),
    )
    with progress_bars() as bars:
        task = bars.add_task("rounds", total=benchmark.num_rounds(options), note="")
        result = benchmark.run(options, lambda: bars.advance(task))
    path = save(result, quick=quick)
    figure = path.with_suffix(".png")
    benchmark.plot(result, figure)
    print_rows(f"{name} on {result.machine['processor']}", benchmark.rows(result))
    console.print(result.as_json_line(), soft_wrap=True)
    console.print(f"\nWritten: {path} and {figure.name}", style="bold")


def _named(name: str) -> _Benchmark:
    """Import only what is asked for: each benchmark needs other libraries."""
    if name == "assets":
        from infra.bench import assets, assets_report

        return _Benchmark(
            num_rounds=assets.num_rounds,
            run=assets.run,
            rows=assets_report.rows,
            plot=assets_report.plot,
        )
    if name == "render":
        from infra.bench import render

        return _Benchmark(
            num_rounds=render.num_rounds, run=render.run, rows=render.rows, plot=render.plot
        )
    if name == "scenes":
        from infra.bench import scenes

        return _Benchmark(
            num_rounds=scenes.num_rounds, run=scenes.run, rows=scenes.rows, plot=scenes.plot
        )
    if name == "shards":
        from infra.bench import shards, shards_report

        return _Benchmark(
            num_rounds=shards.num_rounds,
            run=shards.run,
            rows=shards_report.rows,
            plot=shards_report.plot,
        )
    raise TrilightError(f"benchmark {name!r} is unknown; expected one of {', '.join(_NAMES)}.")
