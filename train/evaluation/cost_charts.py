"""Charts of errors against costs: a marker for each cost, a color for each kind, and names.

A point is drawn at each of its costs, always at the height of its error, with a line between. Also
numbers as text for tables, the Pareto front, and the chart of unusual scenes. Imports no torch.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from storage.palette import METHOD_COLORS, OTHERS

if TYPE_CHECKING:
    from train.evaluation.leaderboard import WidthStandings
    from train.evaluation.metrics import JudgedView

COST_NOISE = 0.03
"""Relative difference below which costs count as equal: CPU seconds vary by that much."""


def number_text(value: float) -> str:
    """Return a number with two or three significant digits, mostly without powers of ten."""
    size = abs(value)
    if value == 0 or size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def on_front(figures: Sequence[tuple[float, Sequence[float]]]) -> list[bool]:
    """Return for each point whether it is on the Pareto front: no other point dominates it.

    A point with less error dominates if none of its costs is more than COST_NOISE higher; one with
    the same error, if none of its costs is higher and one is more than COST_NOISE lower. The front
    is never empty, since a dominating point has less error, or the same error and less cost.

    Args:
        figures: error (smaller is better) and costs above 0 of each point, equally many costs.
    """
    return [not any(_dominates(other, mine) for other in figures) for mine in figures]


def _dominates(other: tuple[float, Sequence[float]], mine: tuple[float, Sequence[float]]) -> bool:
    costs = list(zip(other[1], mine[1], strict=True))
    if other[0] < mine[0]:
        return all(a <= (1 + COST_NOISE) * b for a, b in costs)
    lower = any((1 + COST_NOISE) * a < b for a, b in costs)
    return other[0] == mine[0] and lower and all(a <= b for a, b in costs)


_FONT = 9


@dataclass(frozen=True, kw_only=True)
class SeriesPoint:
    """Point with several costs."""

    name: str
    """Text label beside the marker of the point."""
    kind: str
    """Group of the point, which decides its color."""
    costs: Sequence[float]
    """Costs above 0, one for each series."""
    error: float
    """Error on the vertical axis."""


def draw_panels(
    figure: Any,
    panels: Sequence[Any],
    groups: Sequence[Sequence[SeriesPoint]],
    costs: Sequence[str],
) -> None:
    """Draw each group of points in a panel, with their names and a legend of costs and kinds.

    What else the panels show must be drawn before, since names avoid it.
    """
    from matplotlib.lines import Line2D

    next_colors = itertools.cycle(OTHERS)
    kinds = dict.fromkeys(one.kind for points in groups for one in points)
    colors = {
        name: METHOD_COLORS.get(name.partition(",")[0]) or next(next_colors) for name in kinds
    }
    for axes, points in zip(panels, groups, strict=True):
        axes.grid(alpha=0.25)
        axes.set_xscale("log")
        axes.margins(x=0.14, y=0.12)
        axes.tick_params(labelsize=_FONT)
        for one in points:
            color = colors[one.kind]
            heights = [one.error] * len(one.costs)
            axes.plot(one.costs, heights, "-", color=color, linewidth=1, alpha=0.5)
            for row, cost in enumerate(one.costs):
                face = color if row == 0 else "white"
                axes.plot(cost, one.error, "o", color=color, markerfacecolor=face, markersize=6)
        plain_log(axes.xaxis)
    grey = [
        Line2D([], [], linestyle="", marker="o", color="0.35", label=cost,
               markerfacecolor="0.35" if row == 0 else "white")
        for row, cost in enumerate(costs)
    ]  # fmt: skip
    lines = [Line2D([], [], linewidth=4, color=color, label=name) for name, color in colors.items()]
    figure.legend(
        handles=[*lines, *(grey if len(costs) > 1 else ())],
        loc="outside lower center", ncols=3, fontsize=_FONT, frameon=False,
    )  # fmt: skip
    figure.draw_without_rendering()  # places are known from here on
    for axes, points in zip(panels, groups, strict=True):
        names = [(one.name, (one.costs[0], one.error)) for one in points]
        further_costs = [(cost, one.error) for one in points for cost in one.costs[1:]]
        _place_labels(axes, names, further_costs)


_PLACES = (
    (8, 5, "left", "bottom"),
    (8, -5, "left", "top"),
    (-8, 5, "right", "bottom"),
    (-8, -5, "right", "top"),
    (0, 9, "center", "bottom"),
    (0, -9, "center", "top"),
    (9, 0, "left", "center"),
    (-9, 0, "right", "center"),
    (0, 9, "left", "bottom"),
    (0, -9, "left", "top"),
)
"""Offsets of names in points, with their alignment; the first free one is used."""
_CLEAR_PX = 7
"""Free distance in pixels around each point."""


def _place_labels(
    axes: Any,
    names: Sequence[tuple[str, tuple[float, float]]],
    also_clear: Sequence[tuple[float, float]],
) -> None:
    """Write names beside their points, so that they cover neither a point nor another name.

    A name avoids lines where possible, and is left out where there is no room.

    Args:
        axes: axes of matplotlib that have been drawn, so that positions are known.
        names: pairs of name and point, the most important first.
        also_clear: further points that no name may cover.
    """
    from matplotlib.transforms import Bbox

    lines = [axes.transData.transform_path(line.get_path()) for line in axes.lines]
    centres = [axes.transData.transform(at) for at in (*(at for _, at in names), *also_clear)]
    taken = [
        Bbox.from_extents(x - _CLEAR_PX, y - _CLEAR_PX, x + _CLEAR_PX, y + _CLEAR_PX)
        for x, y in centres
    ]
    frame = axes.get_window_extent()
    for name, at in names:
        labels = []
        for right, up, across, along in _PLACES:
            label = axes.annotate(
                name, at, xytext=(right, up), textcoords="offset points", fontsize=_FONT,
                horizontalalignment=across, verticalalignment=along,
            )  # fmt: skip
            label.set_in_layout(False)  # else the axes made room for it, and positions changed
            labels.append(label)
        boxes = [label.get_window_extent().padded(2) for label in labels]
        free = [
            row
            for row, box in enumerate(boxes)
            if (frame.min <= box.min).all() and (box.max <= frame.max).all()
            and not box.count_overlaps(taken)
        ]  # fmt: skip
        clear = [
            row
            for row in free
            if not any(line.intersects_bbox(boxes[row], filled=False) for line in lines)
        ]
        chosen = next(iter([*clear, *free]), None)
        for row, label in enumerate(labels):
            if row == chosen:
                taken.append(boxes[row])
            else:
                label.remove()


def plain_log(axis: Any) -> None:
    """Label a logarithmic axis with 0.3, 20 and 5000 instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 3)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
    axis.set_minor_formatter(NullFormatter())


_PANEL = (7.4, 6.2)
_DPI = 110
_COSTS = ("a scene's first view", "a further view")


def plot_leaderboard(widths: "Sequence[WidthStandings]", title: str, path: Path) -> None:
    """Draw the panels into a PNG file; entries without a price are lines, NOISE a dashed one."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from train.evaluation.leaderboard import NOISE
    from train.evaluation.metrics import METRIC

    with rc_context({"text.parse_math": False}):  # names may hold dollar signs
        size = (_PANEL[0] * len(widths), _PANEL[1])
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        panels = figure.subplots(1, len(widths), squeeze=False)
        groups = []
        for axes, one in zip(panels.flat, widths, strict=True):
            axes.set_title(f"{one.width} x {one.width} pixels, {one.num_views} views", fontsize=11)
            axes.set_xlabel("CPU seconds, one thread", fontsize=_FONT)
            axes.set_ylabel(f"median {METRIC}, higher is better", fontsize=_FONT)
            groups.append(list[SeriesPoint]())
            for each in one.standings:
                if each.first_s is None or each.further_s is None:
                    style = "--" if each.name == NOISE else ":"
                    axes.axhline(each.median_db, color="0.45", linewidth=1, linestyle=style)
                    axes.annotate(
                        each.name,
                        (1, each.median_db),
                        xycoords=("axes fraction", "data"),
                        xytext=(-4, 3),
                        textcoords="offset points",
                        fontsize=_FONT,
                        color="0.3",
                        horizontalalignment="right",
                    )
                    continue
                costs = [each.first_s, each.further_s]
                groups[-1].append(
                    SeriesPoint(name=each.name, kind=each.kind, costs=costs, error=each.median_db)
                )
        figure.suptitle(title, fontsize=12)
        draw_panels(figure, list(panels.flat), groups, _COSTS)
        figure.savefig(path, metadata={"Software": None})


_COLUMNS = 3
"""Number of plots of axes in a row."""


def plot_excursions(path: Path, views: "Sequence[JudgedView]") -> int:
    """Plot psnr_log_db beyond the usual range of scenes; return the number of axes.

    Each axis has a plot: a dot is a view, the line the median at each value, the dashed line the
    median of the stated errors. Nothing is written if no view leaves the usual range.
    """
    axes: dict[str, list[JudgedView]] = {}
    for view in views:
        if view.excursion is not None:
            axes.setdefault(view.excursion[0], []).append(view)
    if not axes:
        return 0
    from matplotlib.figure import Figure

    from train.evaluation.metrics import NETWORK

    rows = -(-len(axes) // _COLUMNS)
    figure = Figure(figsize=(4.2 * _COLUMNS, 3.2 * rows), layout="constrained")
    grid = figure.subplots(rows, _COLUMNS, squeeze=False)
    for place, (axis, members) in zip(grid.flat, sorted(axes.items()), strict=False):
        at = np.array([view.excursion[1] for view in members if view.excursion is not None])
        scores = np.array([view.scores[NETWORK]["psnr_log_db"] for view in members], float)
        floors = np.array([view.floors["psnr_log_db"] for view in members])
        values = np.unique(at)
        place.plot(at, scores, ".", color="tab:blue", alpha=0.4)
        medians = [np.median(scores[at == value]) for value in values]
        place.plot(values, medians, "-o", color="tab:blue", label="network")
        noise = [np.median(floors[at == value]) for value in values]
        place.plot(values, noise, "--", color="grey", label="stated error")
        place.set(title=axis.replace("_", " "), xlabel="value", ylabel="psnr_log_db")
        if values[0] > 0 and values[-1] / values[0] > 8:
            place.set_xscale("log")
    grid.flat[0].legend()
    for place in grid.flat[len(axes) :]:
        place.axis("off")
    figure.savefig(path, dpi=110)
    return len(axes)
