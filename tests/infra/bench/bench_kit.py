"""An effort of seconds, and an experiment that measures nothing real."""

from collections.abc import Iterable, Sequence

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point
from infra.bench.workshop import Workshop
from storage.errors import Rejected

TINY = Effort(
    name="quick",
    scenes=2,
    resolution=32,
    max_spp=128,
    fixed_spp=64,
    picture_px=32,
    widths=(8, 16, 32, 64),
    objects=2,
    samples=1,
    composed=10,
    network="smoke",
    network_triangles=64,
    network_px=32,
    repeats=2,
    judged_scenes=1,
    reference_spp=128,
    growth=1,
)

calls: list[tuple[str, str]] = []
"""What the experiment below measured, in order."""
FIGURES = {"cheap": (1.0, 30.0), "default": (2.0, 40.0), "waste": (3.0, 35.0)}
"""Cost and error in decibels by point."""


def measure(
    workshop: Workshop, points: Sequence[Point], turn: str
) -> Iterable[tuple[str, Figures]]:
    """Return made-up figures; the turn `bad` cannot be used, and the turn `killed` ends the run."""
    for point in points:
        if turn == "bad" and point.name == "default":
            raise Rejected("no_scene", "it has no light")
        calls.append((turn, point.name))
        if turn == "killed" and point.name == "waste" and not workshop.asked.data:
            raise KeyboardInterrupt
        cost, db = FIGURES[point.name]
        late = 0.5 * (turn == "c")
        yield point.name, {"core_s": cost + late, "db": db}


def experiment(*turns: str, warm_up: bool = False) -> Experiment:
    """Return three points that are measured in these turns."""
    return Experiment(
        name="made-up",
        title="Made up",
        about="Nothing real.",
        cost=Column(name="core-seconds", figure="core_s", over="mean"),
        error=Column(name="psnr_log_db, dB", figure="db"),
        better="higher",
        against="nothing",
        columns=(Column(name="a second", figure="core_s", over="mean", then=lambda s: 1 / s),),
        points=lambda effort: [Point(name=name, default=name == "default") for name in FIGURES],
        turns=lambda effort: turns,
        measure=measure,
        warm_up=warm_up,
    )
