"""Chart of a leaderboard: a panel for each width, CPU seconds against the median error."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from infra.cost_charts import (
    SeriesPoint,
    colors_of,
    draw_legend,
    draw_points,
    name_points,
)
from infra.leaderboard.contest import NOISE
from infra.leaderboard.standings import Standing, WidthStandings
from train.evaluation.pairs import METRIC

_PANEL = (7.4, 6.2)
_DPI = 110
_FONT = 9
_COSTS = ("a scene's first view", "a further view")


def plot_leaderboard(widths: Sequence[WidthStandings], title: str, path: Path) -> None:
    """Draw the panels into a PNG file; entries without a price are lines, NOISE a dashed one."""
    import matplotlib

    matplotlib.use("Agg")  # before pyplot: no display is needed
    with matplotlib.rc_context({"text.parse_math": False}):  # names may hold dollar signs
        _plot(widths, title, path)


def _plot(widths: Sequence[WidthStandings], title: str, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1,
        len(widths),
        figsize=(_PANEL[0] * len(widths), _PANEL[1]),
        dpi=_DPI,
        squeeze=False,
        layout="constrained",
    )
    figure.suptitle(title, fontsize=12)
    points_by_width = [_points(one) for one in widths]
    colors = colors_of([point for points in points_by_width for point in points])
    for axes, one, points in zip(panels.flat, widths, points_by_width, strict=True):
        axes.set_title(f"{one.width} x {one.width} pixels, {one.num_views} views", fontsize=11)
        axes.set_xlabel("core-seconds, one thread", fontsize=_FONT)
        axes.set_ylabel(f"median {METRIC}, higher is better", fontsize=_FONT)
        draw_points(axes, points, colors)
        for standing in one.standings:
            if standing.first_s is None:
                _line_across(axes, standing)
    draw_legend(figure, _COSTS, colors)
    figure.canvas.draw()  # places are known from here on
    for axes, points in zip(panels.flat, points_by_width, strict=True):
        name_points(axes, points)
    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _points(one: WidthStandings) -> list[SeriesPoint]:
    return [
        SeriesPoint(
            name=each.name,
            kind=each.kind,
            costs=[each.first_s, each.further_s],
            error=each.median_db,
        )
        for each in one.standings
        if each.first_s is not None and each.further_s is not None
    ]


def _line_across(axes: Any, standing: Standing) -> None:
    is_noise = standing.name == NOISE
    axes.axhline(standing.median_db, color="0.45", linewidth=1, linestyle="--" if is_noise else ":")
    axes.annotate(
        standing.name,
        (1, standing.median_db),
        xycoords=("axes fraction", "data"),
        xytext=(-4, 3),
        textcoords="offset points",
        fontsize=_FONT,
        color="0.3",
        horizontalalignment="right",
    )
