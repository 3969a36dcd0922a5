"""Experiment `growth`: time and memory against scenes, objects, triangles and shards."""

import tempfile
from functools import partial
from pathlib import Path

from infra.bench.context import BenchContext
from infra.bench.experiment import BenchScale, Column, Experiment, Figures, Point, rounds
from infra.bench.workloads.sized_work import WORK, measure_work, sizes_of
from infra.bench_options import BenchOptions


def _points(scale: BenchScale, options: BenchOptions) -> list[Point]:
    return [
        Point(
            name=f"{name}, {size:,} {work.unit}",
            measure=partial(_measure, name, size),
            kind=f"{name}, {work.unit}",
            size=float(size),
        )
        for name, work in WORK.items()
        for size in sizes_of(work, scale.growth)
    ]


def _measure(name: str, size: int, context: BenchContext, trial: str) -> Figures:
    root = context.get_or_make("root", lambda: _folder_with_sample(context))
    return measure_work(name, size, Path(tempfile.mkdtemp(dir=root)))


def _folder_with_sample(context: BenchContext) -> Path:
    """Return a folder with the files of one rendered scene, which the shards repeat."""
    root = context.folder()
    (root / "sample").mkdir()
    _, members = context.rendered
    for name, data in members[0].items():
        (root / "sample" / name).write_bytes(data)
    return root


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
    needs=("torch",),
)
