"""Experiment `growth`: time and memory against scenes, objects, triangles and shards."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, rounds
from infra.bench.workloads.sized_work import WORK, measure_work, sizes_of
from infra.bench_options import BenchOptions


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    return [
        Point(
            name=f"{name}, {size:,} {work.unit}",
            settings=(name, size),
            kind=f"{name}, {work.unit}",
            size=float(size),
        )
        for name, work in WORK.items()
        for size in sizes_of(work, scale.growth)
    ]


def _measure(
    context: BenchContext, points: Sequence[Point], trial: str
) -> Iterator[tuple[str, Figures]]:
    root = context.folder()
    _keep_sample(context, root / "sample")
    for row, point in enumerate(points):
        folder = root / str(row)
        folder.mkdir()
        name, size = point.settings
        yield point.name, measure_work(name, size, folder)


def _keep_sample(context: BenchContext, folder: Path) -> None:
    """Write the files of one rendered scene, which the shards repeat under many keys."""
    folder.mkdir()
    for name, data in context.members()[0].items():
        (folder / name).write_bytes(data)


EXPERIMENT = Experiment(
    name="growth",
    title="Time and memory against the size of the work",
    about="Datasets of more scenes at 16 pixels, meshes of more objects, views of more triangles "
    "at 64 pixels, and more shards of one scene: each in a fresh process that did a small one.",
    cost=Column(name="seconds", figure="seconds"),
    columns=(Column(name="MB at most", figure="peak_bytes", then=lambda size: size / 1e6),),
    also_cost=("MB at most",),
    because="Seconds are on the clock; memory is that of the process and its children.",
    points=_points,
    trials=rounds,
    measure=_measure,
    needs=("torch",),
)
