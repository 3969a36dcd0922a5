"""The figure of points that stand on lines: each further column a panel, each line a colour."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from infra.bench.curve import Row
from infra.bench.experiment import Experiment, Point
from infra.bench.labels import plain_log

_WIDE, _HIGH, _DPI = 2.9, 3.2, 110
"""Inches of a panel, and its resolution."""

_FONT = 8

LineOf = Callable[[Point], tuple[str, float]]
"""Names the line that a point stands on, and where on it, above 0."""


def plot_lines(experiment: Experiment, line_of: LineOf, points: Sequence[Row], path: Path) -> None:
    """Draw the points of a run into a PNG file; columns that were not measured have no panel."""
    import matplotlib.pyplot as plt

    assert experiment.error is not None
    names = [
        column.name
        for column in experiment.columns
        if any(column.name in row.values for row in points)
    ]
    figure, panels = plt.subplots(
        1, len(names), figsize=(_WIDE * len(names) + 0.6, _HIGH), dpi=_DPI, sharey=True,
        squeeze=False, layout="constrained",
    )  # fmt: skip
    figure.suptitle(experiment.title, fontsize=_FONT + 2)
    for axes, name in zip(panels[0], names, strict=True):
        _panel(axes, name, line_of, points)
    panels[0][0].set_ylabel(
        f"{experiment.error.name}\n{experiment.better} is better", fontsize=_FONT
    )
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=2, fontsize=_FONT, frameon=False
    )
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _panel(axes: Any, name: str, line_of: LineOf, points: Sequence[Row]) -> None:
    lines = defaultdict[str, list[tuple[float, float]]](list)
    for row in points:
        line, at = line_of(row.point)
        if name in row.values:
            lines[line].append((at, row.values[name]))
    for number, (line, places) in enumerate(lines.items()):
        style = {"color": f"C{number % 2}", "linestyle": ("-", "--")[number // 2 % 2]}
        axes.plot(*zip(*sorted(places), strict=True), marker="o", markersize=3, label=line, **style)
    axes.set_title(name, fontsize=_FONT)
    axes.set_xscale("log")
    plain_log(axes.xaxis)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=_FONT - 1)
