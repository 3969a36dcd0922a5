"""Core-seconds per million paths against triangles, lights, depth and resolution, one at a time.

Tracing alone: one pass of the product's tracer, without the denoiser, on the scene family of
infra.bench.renders.cost_scene. The values of all axes take turns; the first round compiles.
"""

import contextlib
import dataclasses
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from infra.bench.harness import Comparison, Options, Spread, compare
from infra.bench.render_child import smoke_child
from infra.bench.renders.cost_scene import cost_scene
from pipeline.isolation import IsolatedChild
from pipeline.renders.camera import Camera
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.settings import PASS_SPP, RenderSettings

NAME = "render-cost"
_SEED = 20_261_121


@dataclass(frozen=True, kw_only=True)
class Point:
    """One value of every axis; the defaults are what stays fixed on the others."""

    triangles: int = 1000
    """Of the scene, about."""
    lights: int = 4
    """Emitting triangles."""
    depth: int = RenderSettings.max_depth
    """Longest path in edges."""
    resolution: int = 256
    """Pixels each way."""


AXES: Mapping[str, tuple[int, ...]] = {
    "triangles": (100, 316, 1000, 3162, 10_000, 31_623),
    "lights": (1, 2, 4, 8, 16, 32),
    "depth": (2, 3, 4, 6, 8, 12, 16),
    "resolution": (64, 128, 256, 512),
}
_LABELS = {
    "triangles": "triangles of the scene",
    "lights": "lights (emitting triangles)",
    "depth": "longest path, edges",
    "resolution": "resolution, pixels each way",
}


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return len(_points()) * (1 + _repeats(options))


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure; quickly one counted round, otherwise five."""
    with tempfile.TemporaryDirectory() as folder:
        threads = os.cpu_count() or 1
        with contextlib.closing(smoke_child(Path(folder), threads=threads)) as child:
            sides = {name: _side(child, point) for name, point in _points().items()}
            return compare(NAME, sides, repeats=_repeats(options), round_done=round_done)


def _points() -> dict[str, Point]:
    return {
        f"{axis} {value}": dataclasses.replace(Point(), **{axis: value})
        for axis, values in AXES.items()
        for value in values
    }


def _repeats(options: Options) -> int:
    return 1 if options.quick else 5


def _side(child: IsolatedChild, point: Point) -> Callable[[], Mapping[str, float]]:
    return lambda: child.call(traced, point)


def traced(point: Point) -> Mapping[str, float]:
    """Load the scene and trace one pass, in a render child."""
    scene = cost_scene(point.triangles, point.lights)
    camera = Camera(
        c2w=np.asarray(scene.c2w[0], np.float64),
        fov_deg=float(scene.fov_deg[0]),
        resolution=point.resolution,
    )
    started = time.process_time()
    tracer = load_tracer(scene, max_depth=point.depth, rr_depth=RenderSettings.rr_depth)
    loaded = time.process_time()
    tracer.radiance(camera, seed=_SEED, spp=PASS_SPP[0])
    core_s = time.process_time() - loaded
    megapaths = point.resolution**2 * PASS_SPP[0] / 1e6
    return {
        "core_s_per_megapath": core_s / megapaths,
        "load_core_s": loaded - started,
        "triangles": scene.num_triangles,
    }


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    return [(side, _line(figures)) for side, figures in result.sides.items()]


def _line(figures: Mapping[str, Spread]) -> str:
    cost = figures["core_s_per_megapath"]
    return (
        f"{cost.median:.3f} core-s per million paths ({cost.low:.3f} to {cost.high:.3f}), loading "
        f"{figures['load_core_s'].median:.3f} core-s"
    )


def plot(result: Comparison, path: Path) -> None:
    """Draw core-seconds per million paths against each axis, smallest to largest as bars."""
    measured = {
        axis: [(int(side.split()[1]), side) for side in result.sides if side.startswith(axis)]
        for axis in AXES
    }
    figure, panels = plt.subplots(2, 2, figsize=(10, 7), layout="constrained", sharey=True)
    for axes, (axis, values) in zip(panels.flat, measured.items(), strict=True):
        costs = [result.sides[side]["core_s_per_megapath"] for _, side in values]
        places = [value for value, _ in values]
        medians = [cost.median for cost in costs]
        spread = [
            [cost.median - cost.low for cost in costs],
            [cost.high - cost.median for cost in costs],
        ]
        axes.errorbar(places, medians, yerr=spread, fmt="o-", capsize=3)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator(places))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_xlabel(_LABELS[axis])
        axes.grid(alpha=0.3)
    panels[0, 0].set_ylim(bottom=0)
    for axes in panels[:, 0]:
        axes.set_ylabel("core-seconds per million paths")
    figure.suptitle(
        f"Tracing, one axis at a time around {_words(Point())}; "
        f"{result.machine['cores']} cores, {result.date}"
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _words(point: Point) -> str:
    return (
        f"{point.triangles} triangles, {point.lights} lights, depth {point.depth}, "
        f"{point.resolution} pixels"
    )
