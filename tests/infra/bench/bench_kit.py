"""A scale of seconds, and an experiment that measures nothing real."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

from infra.bench.catalogue import experiment_of
from infra.bench.context import BenchContext
from infra.bench.experiment import QUICK, Column, Experiment, Figures, Point
from infra.bench.rows import Row, rows_of
from infra.bench.run import run
from infra.bench_options import BenchOptions
from storage.errors import Rejected

TINY = dataclasses.replace(
    QUICK, scenes=1, resolution=32, max_spp=128, reference_spp=128, picture_px=64, objects=2,
    repeats=1, steps=2, held_out=2, growth=1,
)  # fmt: skip

calls: list[tuple[str, str]] = []
"""What the experiment below measured, in order."""
FIGURES = {"cheap": (1.0, 30.0), "default": (2.0, 40.0), "waste": (3.0, 35.0)}
"""Cost and error in decibels by point."""


def measure(
    context: BenchContext, points: Sequence[Point], trial: str
) -> Iterable[tuple[str, Figures]]:
    """Return made-up figures; the trial `bad` cannot be used, and `killed` ends the run."""
    for point in points:
        if trial == "bad" and point.name == "default":
            raise Rejected("no_scene", "it has no light")
        calls.append((trial, point.name))
        if trial == "killed" and point.name == "waste" and not context.options.data:
            raise KeyboardInterrupt
        cost, db = FIGURES[point.name]
        late = 0.5 * (trial == "c")
        yield point.name, {"core_s": cost + late, "db": db}


def experiment(*trials: str, warm_up: bool = False) -> Experiment:
    """Return three points that are measured in these trials."""
    return Experiment(
        name="made-up",
        title="Made up",
        about="Nothing real.",
        cost=Column(name="core-seconds", figure="core_s", over="mean"),
        error=Column(name="psnr_log_db, dB", figure="db"),
        better="higher",
        columns=(
            Column(name="a second", figure="core_s", over="mean", then=lambda s: 1 / s),
            Column(name="more than default, dB", figure="db", over="pair"),
        ),
        points=lambda scale, options: [
            Point(
                name=name,
                default=name == "default",
                kind="cheap ones" if name == "cheap" else "others",
                rival=None if name == "default" else "default",
            )
            for name in FIGURES
        ],
        trials=lambda scale, options: trials,
        measure=measure,
        warm_up=warm_up,
    )


def measured_rows(name: str, folder: Path, options: BenchOptions | None = None) -> dict[str, Row]:
    """Measure an experiment for real at the scale TINY; return its rows by point."""
    one, out = experiment_of(name), folder / f"{name}.jsonl"
    found = run(one, TINY, options or BenchOptions(), out)
    assert found.seconds is not None
    assert out.with_suffix(".png").stat().st_size > 5000
    return {row.point.name: row for row in rows_of(one, found)}
