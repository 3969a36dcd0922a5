"""`trilight bench`: one benchmark, or its parts in turn: figures, and a dated result of each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from infra.cli.console import console, first_words, print_rows, progress_bars
from infra.cli.options import command
from pipeline.flows.price import CorePrice
from pipeline.objects.licences import DEFAULT_ALLOWED
from storage.errors import TrilightError
from storage.settings import checked
from storage.suggestion import expected_one_of

if TYPE_CHECKING:
    from infra.bench.harness import Options, Result

Name = Literal[
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
]
"""Every benchmark."""

_Measured = TypeVar("_Measured", bound="Result")


@dataclass(frozen=True, kw_only=True)
class _Benchmark(Generic[_Measured]):
    """A benchmark, or one part of several that it has."""

    num_rounds: "Callable[[Options], int]"
    run: "Callable[[Options, Callable[[], None]], _Measured]"
    rows: "Callable[[_Measured], list[tuple[str, str]]]"
    plot: "Callable[[_Measured, Path], None]"
    part: str = ""


@checked()
class Measured:
    """What is measured."""

    name: Name
    """The benchmark."""
    quick: bool = False
    """Take minutes instead of measuring carefully."""
    objects: tuple[str, ...] = ("builtin:",)
    """Sources of objects."""
    allow_licences: tuple[str, ...] = ()
    """Licences of objects that are measured too; by default the usual ones are."""
    parts: tuple[str, ...] = ()
    """Parts of it, by default all. render: frontier, throughput, cost; model: cases, growth;
    orchestration: overhead, workers."""
    scenes: Path | None = None
    """render: folder of RenderFormer scenes to add to the set; by default none."""
    cycles: str | None = None
    """render: Cycles at these samples too, such as 128,4096, for which Blender is installed; by
    default not."""
    resume: bool = False
    """render, trade: go on with the same run where it was interrupted."""
    knobs: tuple[str, ...] = ()
    """trade: these knobs alone; by default all."""
    checkpoint: str = "builtin:"
    """trade: network to compare with the path tracer."""
    write_docs: bool = False
    """trade: measure nothing, write docs/tradeoffs.md from the results."""


@command("name")
def bench(asked: Measured, core: CorePrice) -> None:
    if asked.write_docs:
        _write_docs(asked.name)
        return
    first_words(f"Measuring {asked.name}")
    benchmarks = _chosen(asked.name, asked.parts)
    from infra.bench.harness import Options

    options = Options(
        quick=asked.quick,
        objects=asked.objects,
        allowed_licences=(*DEFAULT_ALLOWED, *asked.allow_licences),
        scenes=asked.scenes,
        cycles_spp=_samples(asked.cycles or ""),
        usd_per_core_hour=core.price,
        resume=asked.resume,
        knobs=asked.knobs,
        checkpoint=asked.checkpoint,
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


def _chosen(name: Name, parts: tuple[str, ...]) -> list[_Benchmark[Any]]:
    """Return a benchmark, or those of its parts that are asked for."""
    benchmarks = _named(name)
    known = [benchmark.part for benchmark in benchmarks if benchmark.part]
    for part in parts:
        if part not in known:
            expected = expected_one_of(part, known) if known else "it has no parts"
            raise TrilightError(f"--parts {part!r}: unknown in benchmark {name!r}; {expected}.")
    return [benchmark for benchmark in benchmarks if not parts or benchmark.part in parts]


def _named(name: Name) -> list[_Benchmark[Any]]:
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
    from infra.bench.trade import run as trade

    return [_whole(trade, trade)]


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
