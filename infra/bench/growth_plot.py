"""The figure of costs that grow with a size: each cost a panel, each line what is measured."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from infra.bench.curve import Row
from infra.bench.experiment import Experiment, Point
from infra.bench.growth import fitted_exponent, is_steady
from infra.bench.labels import plain_log

_WIDE, _HIGH, _DPI = 4.6, 4.2, 100
"""Inches of a panel, and its resolution."""
_FONT = 8

SizeOf = Callable[[Point], tuple[str, float]]
"""Names the line that a point stands on, and its size, above 0."""


def plot_growth(experiment: Experiment, size_of: SizeOf, points: Sequence[Row], path: Path) -> None:
    """Draw the points of a run into a PNG file, with the exponent of every steady line."""
    import matplotlib.pyplot as plt

    names = (experiment.cost.name, *experiment.also_cost)
    figure, panels = plt.subplots(
        1, len(names), figsize=(_WIDE * len(names), _HIGH), dpi=_DPI, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    figure.suptitle(experiment.title, fontsize=_FONT + 2)
    for axes, name in zip(panels[0], names, strict=True):
        _panel(axes, name, size_of, points)
        axes.set_xlabel(experiment.against_size, fontsize=_FONT)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _panel(axes: Any, name: str, size_of: SizeOf, points: Sequence[Row]) -> None:
    lines = defaultdict[str, list[tuple[float, float]]](list)
    for row in points:
        line, size = size_of(row.point)
        if row.values.get(name, 0) > 0:
            lines[line].append((size, row.values[name]))
    for number, (line, places) in enumerate(lines.items()):
        sizes, costs = zip(*sorted(places), strict=True)
        fits = len(sizes) > 1 and is_steady(costs)
        power = f" ~ n^{fitted_exponent(sizes, costs):.1f}" if fits else ""
        style = {"color": f"C{number % 10}", "linestyle": ("-", "--", ":")[number // 4 % 3]}
        axes.plot(sizes, costs, marker="o", markersize=3, label=f"{line}{power}", **style)
    axes.set_title(name, fontsize=_FONT)
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain_log(axes.xaxis)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=_FONT - 1)
    axes.legend(fontsize=_FONT - 2)
