"""Charts of a leaderboard, CPU seconds against the median error, and of unusual scenes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from train.evaluation.cost_charts import SeriesPoint, draw_panels
from train.evaluation.judged_view import METRIC, NETWORK, JudgedView
from train.evaluation.leaderboard import NOISE, WidthStandings

_PANEL = (7.4, 6.2)
_DPI = 110
_FONT = 9
_COSTS = ("a scene's first view", "a further view")


def plot_leaderboard(widths: Sequence[WidthStandings], title: str, path: Path) -> None:
    """Draw the panels into a PNG file; entries without a price are lines, NOISE a dashed one."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

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


def plot_excursions(path: Path, views: Sequence[JudgedView]) -> int:
    """Plot psnr_log_db beyond the usual range of scenes; return the number of axes.

    Each axis has a plot: a dot is a view, the line the median at each value, the dashed line the
    median of the stated errors. Nothing is written if no view leaves the usual range.
    """
    from matplotlib.figure import Figure

    axes: dict[str, list[JudgedView]] = {}
    for view in views:
        if view.excursion is not None:
            axes.setdefault(view.excursion[0], []).append(view)
    if not axes:
        return 0
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
