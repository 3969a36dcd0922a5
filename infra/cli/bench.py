"""`trilight bench`: one benchmark, or its parts in turn: figures, and a dated result of each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar

import typer

from infra.cli.console import console, first_words, print_rows, progress_bars
from pipeline.flows.price import USD_PER_CORE_HOUR, CorePrice
from pipeline.objects.licences import DEFAULT_ALLOWED
from storage.errors import TrilightError
from storage.suggestion import expected_one_of

if TYPE_CHECKING:
    from infra.bench.harness import Options, Result

_NAMES = (
    "assets",
    "exchange",
    "model",
    "orchestration",
    "render",
    "scenes",
    "shards",
    "soak",
    "streaming",
    "trade",
)

_Measured = TypeVar("_Measured", bound="Result")


@dataclass(frozen=True, kw_only=True)
class _Benchmark(Generic[_Measured]):
    """A benchmark, or one part of several that it has."""

    num_rounds: "Callable[[Options], int]"
    run: "Callable[[Options, Callable[[], None]], _Measured]"
    rows: "Callable[[_Measured], list[tuple[str, str]]]"
    plot: "Callable[[_Measured, Path], None]"
    part: str = ""


def bench(
    name: Annotated[str, typer.Argument(help=f"one of: {', '.join(_NAMES)}")],
    quick: Annotated[bool, typer.Option(help="minutes instead of a careful measurement")] = False,
    objects: Annotated[
        list[str] | None, typer.Option(help="source of objects; may be repeated [builtin:]")
    ] = None,
    allow_licence: Annotated[
        list[str] | None, typer.Option(help="measure objects under this licence too")
    ] = None,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="render: frontier, throughput, cost; model: cases, growth; orchestration: "
            "overhead, workers; may be repeated [all]"
        ),
    ] = None,
    scenes: Annotated[
        Path | None, typer.Option(help="render: folder of RenderFormer scenes to add to the set")
    ] = None,
    cycles: Annotated[
        str, typer.Option(help="render: Cycles at these samples too, as 128,4096; installs Blender")
    ] = "",
    price: Annotated[float, typer.Option(help="render: USD per core-hour")] = USD_PER_CORE_HOUR,
    resume: Annotated[
        bool, typer.Option(help="render, trade: go on with the same run where it was interrupted")
    ] = False,
    knob: Annotated[
        list[str] | None, typer.Option(help="trade: this knob alone; may be repeated [all]")
    ] = None,
    checkpoint: Annotated[
        str, typer.Option(help="trade: network to compare with the path tracer [the shipped one]")
    ] = "builtin:",
    write_docs: Annotated[
        bool, typer.Option(help="trade: measure nothing, write docs/tradeoffs.md from the results")
    ] = False,
) -> None:
    """Run a benchmark; writes a dated JSON line and a figure under docs/bench."""
    if write_docs:
        _write_docs(name)
        return
    if name in _NAMES:
        first_words(f"Measuring {name}")
    benchmarks = _chosen(name, part or [])
    from infra.bench.harness import Options

    options = Options(
        quick=quick,
        objects=tuple(objects or ("builtin:",)),
        allowed_licences=(*DEFAULT_ALLOWED, *(allow_licence or ())),
        scenes=scenes,
        cycles_spp=_samples(cycles),
        usd_per_core_hour=CorePrice(price=price).price,
        resume=resume,
        knobs=tuple(knob or ()),
        checkpoint=checkpoint,
    )
    for benchmark in benchmarks:
        _measure(benchmark, options)


def _write_docs(name: str) -> None:
    if name != "trade":
        raise TrilightError(f"--write-docs was given with {name}; expected it only with trade.")
    from infra.bench.harness import RESULTS
    from infra.bench.marked_block import write_block
    from infra.bench.trade.figures import FIGURES, write_figures
    from infra.bench.trade.page import MARK, block
    from infra.bench.trade.saved import saved_curves

    page = RESULTS.parent / "tradeoffs.md"
    write_block(page, MARK, block(RESULTS))
    write_figures(saved_curves(RESULTS), RESULTS / FIGURES)
    console.print(f"Written: {page}, and its figures", style="bold")


def _measure(benchmark: _Benchmark[Any], options: "Options") -> None:
    from infra.bench.harness import save

    with progress_bars() as bars:
        total = benchmark.num_rounds(options)
        task = bars.add_task(benchmark.part or "rounds", total=total, note="")
        result = benchmark.run(options, lambda: bars.advance(task))
    path = save(result, quick=options.quick)
    figure = path.with_suffix(".png")
    benchmark.plot(result, figure)
    console.print(result.as_json_line(), soft_wrap=True)
    print_rows(f"{result.name} on {result.machine['processor']}", benchmark.rows(result))
    console.print(f"\nWritten: {path} and {figure.name}", style="bold")


def _samples(text: str) -> tuple[int, ...]:
    words = text.split(",") if text else []
    if not all(word.isdecimal() and int(word) > 0 for word in words):
        raise TrilightError(f"--cycles {text!r}: expected numbers of samples between commas.")
    return tuple(sorted({int(word) for word in words}))


def _chosen(name: str, parts: list[str]) -> list[_Benchmark[Any]]:
    """Return a benchmark, or those of its parts that are asked for."""
    benchmarks = _named(name)
    known = [benchmark.part for benchmark in benchmarks if benchmark.part]
    for part in parts:
        if part not in known:
            expected = expected_one_of(part, known) if known else "it has no parts"
            raise TrilightError(f"--part {part!r}: unknown in benchmark {name!r}; {expected}.")
    return [benchmark for benchmark in benchmarks if not parts or benchmark.part in parts]


def _named(name: str) -> list[_Benchmark[Any]]:
    """Import only what is asked for: each benchmark needs other libraries."""
    if name == "assets":
        from infra.bench import assets, assets_report

        return [_whole(assets, assets_report)]
    if name == "exchange":
        from infra.bench import exchange

        return [_whole(exchange, exchange)]
    if name == "model":
        return _model_parts()
    if name == "orchestration":
        from infra.bench import orchestration, workers

        overhead = _whole(orchestration, orchestration, "overhead")
        return [overhead, _whole(workers, workers, "workers")]
    if name == "render":
        return _render_parts()
    if name == "scenes":
        from infra.bench import scenes

        return [_whole(scenes, scenes)]
    if name == "shards":
        from infra.bench import shards, shards_report

        return [_whole(shards, shards_report)]
    if name == "soak":
        from infra.bench import soak

        return [_whole(soak, soak)]
    if name == "streaming":
        from infra.bench import streaming, streaming_report

        return [_whole(streaming, streaming_report)]
    if name == "trade":
        from infra.bench.trade import run as trade

        return [_whole(trade, trade)]
    raise TrilightError(f"benchmark {name!r} is unknown; {expected_one_of(name, _NAMES)}.")


def _whole(module: Any, report: Any, part: str = "") -> _Benchmark[Any]:
    return _Benchmark(
        num_rounds=module.num_rounds,
        run=module.run,
        rows=report.rows,
        plot=report.plot,
        part=part,
    )


def _model_parts() -> list[_Benchmark[Any]]:
    try:
        from infra.bench.model import cases, cases_report, growth
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise TrilightError("bench model: torch is not installed; run `make setup-all`.") from error
    return [_whole(cases, cases_report, "cases"), _whole(growth, growth, "growth")]


def _render_parts() -> list[_Benchmark[Any]]:
    from infra.bench.renders import (
        cost,
        frontier,
        frontier_report,
        throughput,
        throughput_report,
    )

    return [
        _whole(frontier, frontier_report, "frontier"),
        _whole(throughput, throughput_report, "throughput"),
        _whole(cost, cost, "cost"),
    ]
