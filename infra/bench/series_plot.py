"""The figure of points that have several costs: each cost a series, each kind of point a colour.

A point stands at its first cost and at each further one, both at its error, with a line between.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from infra.bench.curve import Row
from infra.bench.experiment import Experiment
from infra.bench.labels import place_labels, plain_log

_WIDE, _HIGH, _DPI = 8.0, 5.2, 120
"""Inches of the figure, and its resolution."""

_COLOURS = ("#c0392b", "#2e7d32", "#1f5fa8", "#7d5a00", "#6a3d9a")
"""Of kinds, in the order in which they come; dark enough for small marks on white."""

_FONT = 9


@dataclass(frozen=True, kw_only=True)
class SeriesPoint:
    """One point with several costs."""

    name: str
    """Written beside it."""
    kind: str
    """What it is one of: its colour."""
    costs: Sequence[float]
    """Above 0, one for each series."""
    error: float
    """Its height."""


def plot_series(
    experiment: Experiment, kind: Callable[[str], str], points: Sequence[Row], path: Path
) -> None:
    """Draw the points of a run into a PNG file.

    Args:
        experiment: with an error.
        kind: of a point, by its name.
        points: one at least.
        path: of the file.
    """
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(_WIDE, _HIGH), dpi=_DPI, layout="constrained")
    assert experiment.error is not None
    error, costs = experiment.error.name, (experiment.cost.name, *experiment.also_cost)
    shown = [
        SeriesPoint(
            name=one.point.name,
            kind=kind(one.point.name),
            costs=[one.values[cost] for cost in costs],
            error=one.values[error],
        )
        for one in points
    ]
    axes.set_title(experiment.title, fontsize=11)
    axes.set_ylabel(f"{error}, {experiment.better} is better", fontsize=_FONT)
    axes.set_xlabel(costs[0] if len(costs) == 1 else "core-seconds", fontsize=_FONT)
    colours = colours_of(shown)
    draw_points(axes, shown, colours)
    draw_legend(figure, costs, colours)
    figure.canvas.draw()  # places are known from here on
    name_points(axes, shown)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def colours_of(points: Sequence[SeriesPoint]) -> dict[str, str]:
    """Return the colour of each kind, in the order in which they come."""
    kinds = list(dict.fromkeys(one.kind for one in points))
    return {name: _COLOURS[row % len(_COLOURS)] for row, name in enumerate(kinds)}


def draw_points(axes: Any, points: Sequence[SeriesPoint], colours: Mapping[str, str]) -> None:
    """Draw each point at each of its costs, on a logarithmic axis."""
    axes.grid(alpha=0.25)
    axes.set_xscale("log")
    axes.margins(x=0.14, y=0.12)
    axes.tick_params(labelsize=_FONT)
    for one in points:
        colour = colours[one.kind]
        heights = [one.error] * len(one.costs)
        axes.plot(one.costs, heights, "-", color=colour, linewidth=1, alpha=0.5)
        for row, cost in enumerate(one.costs):
            face = colour if row == 0 else "white"
            axes.plot(cost, one.error, "o", color=colour, markerfacecolor=face, markersize=6)
    plain_log(axes.xaxis)


def name_points(axes: Any, points: Sequence[SeriesPoint]) -> None:
    """Write each name beside the point's first cost; the figure was drawn once."""
    names = [(one.name, (one.costs[0], one.error)) for one in points]
    others = [(cost, one.error) for one in points for cost in one.costs[1:]]
    place_labels(axes, names, font=_FONT, also_clear=others)


def draw_legend(figure: Any, costs: Sequence[str], colours: Mapping[str, str]) -> None:
    """Say below the axes which mark is which cost, and which colour which kind."""
    from matplotlib.lines import Line2D

    grey = [
        Line2D([], [], linestyle="", marker="o", color="0.35", label=cost,
               markerfacecolor="0.35" if row == 0 else "white")
        for row, cost in enumerate(costs)
    ]  # fmt: skip
    kinds = [
        Line2D([], [], linewidth=4, color=colour, label=name) for name, colour in colours.items()
    ]
    figure.legend(
        handles=[*kinds, *(grey if len(costs) > 1 else ())],
        loc="outside lower center", ncols=3, fontsize=_FONT, frameon=False,
    )  # fmt: skip
