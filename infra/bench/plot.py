"""The one figure of an experiment: error against cost, or costs alone as bars.

Points are named where there is room: the table beside the figure has all names. An experiment of
several kinds of points has the figure of infra.bench.series_plot, one of lines that of
infra.bench.line_plot, one of sizes that of infra.bench.growth_plot.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from infra.bench.curve import COST_NOISE, Row, rows
from infra.bench.experiment import Experiment
from infra.bench.growth_plot import plot_growth
from infra.bench.labels import place_labels, plain_log
from infra.bench.line_plot import plot_lines
from infra.bench.series_plot import plot_series
from infra.bench.store import Run

_WIDE, _HIGH, _DPI = 6.0, 4.0, 90
"""Inches of the figure, and its resolution."""
_LEAST_SPAN = 0.02
"""Share of its values that an axis spans at least: what hardly differs must not look far apart."""


def plot(experiment: Experiment, run: Run, path: Path) -> None:
    """Draw a run into a PNG file."""
    import matplotlib

    matplotlib.use("Agg")  # before pyplot: no display is needed
    import matplotlib.pyplot as plt

    points = rows(experiment, run)
    if experiment.size_of is not None:
        plot_growth(experiment, experiment.size_of, points, path)
        return
    if experiment.line_of is not None:
        plot_lines(experiment, experiment.line_of, points, path)
        return
    if experiment.kind is not None:
        plot_series(experiment, experiment.kind, points, path)
        return
    high = _HIGH if experiment.error else 1.2 + 0.28 * len(points)
    figure, axes = plt.subplots(figsize=(_WIDE, high), dpi=_DPI, layout="constrained")
    axes.set_title(f"{experiment.title} ({experiment.name})", fontsize=9)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=7)
    if experiment.error is None:
        _bars(axes, experiment, points)
    else:
        names = _points(axes, experiment, points)
        figure.canvas.draw()  # places are known from here on
        place_labels(axes, names)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _bars(axes: Any, experiment: Experiment, points: Sequence[Row]) -> None:
    costs = [one.values[experiment.cost.name] for one in points]
    spreads = [
        (cost - one.cost_spread.low, one.cost_spread.high - cost) if one.cost_spread else (0, 0)
        for one, cost in zip(points, costs, strict=True)
    ]
    bars = [[max(0.0, side) for side in sides] for sides in zip(*spreads, strict=True)]
    axes.barh([one.point.name for one in points], costs, xerr=bars, ecolor="grey")
    axes.invert_yaxis()
    axes.set_xlabel(experiment.cost.name, fontsize=7)
    if max(costs) > 30 * min(costs):
        axes.set_xscale("log")
        plain_log(axes.xaxis)


def _points(
    axes: Any, experiment: Experiment, points: Sequence[Row]
) -> list[tuple[str, tuple[float, float]]]:
    """Draw error against cost ratio; return names and places, those that matter most first."""
    assert experiment.error is not None
    name = experiment.error.name
    errors = [one.values[name] for one in points if name in one.values]
    _scale(axes, [one.cost_ratio for one in points], errors)
    for one in points:
        if name in one.values:
            _mark(axes, one, one.values[name], "x" if one.on_front is None else "o")
    front = sorted((one.cost_ratio, one.values[name]) for one in points if one.on_front)
    if front and not experiment.also_cost:  # with more costs than this axis a front is no line
        axes.plot(*zip(*front, strict=True), "-", color="C0", linewidth=1)
    lowest, highest = _widened(axes.get_ylim(), _LEAST_SPAN)
    for one in points:
        if name not in one.values:  # its cost is known, and stands at the lower edge
            _mark(axes, one, lowest, "^")
    axes.set_ylim(lowest, highest)
    axes.set_xlim(_widened(axes.get_xlim(), 2 * COST_NOISE))
    base = "that of the default" if any(one.point.default for one in points) else "the first"
    axes.set_xlabel(f"{experiment.cost.name}, divided by {base}", fontsize=7)
    axes.set_ylabel(f"{name}\n{experiment.better} is better", fontsize=7)
    first = sorted(points, key=lambda one: (not one.point.default, not one.on_front))
    return [(one.point.name, (one.cost_ratio, one.values.get(name, lowest))) for one in first]


def _scale(axes: Any, ratios: Sequence[float], errors: Sequence[float]) -> None:
    """Choose logarithmic axes where figures are of several sizes."""
    if max(ratios) > 3 * min(ratios):
        axes.set_xscale("log")
        plain_log(axes.xaxis)
    if errors and max(errors) > 30 * min(errors) > 0:
        axes.set_yscale("log")
    axes.margins(0.18)


def _widened(ends: tuple[float, float], share: float) -> tuple[float, float]:
    """Return ends with the same middle that are at least a share of it apart."""
    low, high = ends
    middle = (low + high) / 2
    half = max((high - low) / 2, share * abs(middle) / 2)
    return middle - half, middle + half


def _mark(axes: Any, one: Row, height: float, style: str) -> None:
    """Draw one point: coloured where it is on the front, ringed where it is the default."""
    colour = "C0" if one.on_front else "0.6"
    axes.plot(one.cost_ratio, height, style, color=colour, markersize=5, clip_on=False)
    if one.point.default:
        ring = {"color": "C3", "markersize": 10, "fillstyle": "none", "clip_on": False}
        axes.plot(one.cost_ratio, height, "o", **ring)
