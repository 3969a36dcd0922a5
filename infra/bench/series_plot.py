"""The figure of points that have several costs: each cost a series, each kind of point a colour.

A point stands at its first cost and at each further one, both at its error, with a line between.
"""

from collections.abc import Callable, Mapping, Sequence
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
    axes.set_title(experiment.title, fontsize=11)
    axes.grid(alpha=0.25)
    axes.set_xscale("log")
    axes.margins(x=0.14, y=0.12)
    axes.tick_params(labelsize=_FONT)
    assert experiment.error is not None
    axes.set_ylabel(f"{experiment.error.name}, {experiment.better} is better", fontsize=_FONT)
    kinds = list(dict.fromkeys(kind(one.point.name) for one in points))
    colours = {name: _COLOURS[row % len(_COLOURS)] for row, name in enumerate(kinds)}
    costs = (experiment.cost.name, *experiment.also_cost)
    axes.set_xlabel(costs[0] if len(costs) == 1 else "core-seconds", fontsize=_FONT)
    names = [
        _draw(axes, one, experiment.error.name, costs, colours[kind(one.point.name)])
        for one in points
    ]
    plain_log(axes.xaxis)
    _legend(axes, costs, colours)
    figure.canvas.draw()  # places are known from here on
    name = experiment.error.name
    others = [(one.values[cost], one.values[name]) for one in points for cost in costs[1:]]
    place_labels(axes, names, font=_FONT, also_clear=others)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _draw(
    axes: Any, one: Row, error: str, costs: Sequence[str], colour: str
) -> tuple[str, tuple[float, float]]:
    """Draw one point at each of its costs; return its name, and where it stands at the first."""
    height, at = one.values[error], [one.values[cost] for cost in costs]
    axes.plot(at, [height] * len(at), "-", color=colour, linewidth=1, alpha=0.5)
    for row, cost in enumerate(at):
        face = colour if row == 0 else "white"
        axes.plot(cost, height, "o", color=colour, markerfacecolor=face, markersize=6)
    return one.point.name, (at[0], height)


def _legend(axes: Any, costs: Sequence[str], colours: Mapping[str, str]) -> None:
    from matplotlib.lines import Line2D

    grey = [
        Line2D([], [], linestyle="", marker="o", color="0.35", label=cost,
               markerfacecolor="0.35" if row == 0 else "white")
        for row, cost in enumerate(costs)
    ]  # fmt: skip
    kinds = [
        Line2D([], [], linewidth=4, color=colour, label=name) for name, colour in colours.items()
    ]
    axes.figure.legend(
        handles=[*kinds, *(grey if len(costs) > 1 else ())],
        loc="outside lower center", ncols=3, fontsize=_FONT, frameon=False,
    )  # fmt: skip
