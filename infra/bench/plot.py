"""Plot of an experiment: costs against sizes, errors against costs, or costs as bars."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from infra.bench.experiment import Experiment
from infra.bench.rows import Row, rows_of
from infra.bench.store import Run
from pipeline.documents.figures import drawing
from train.evaluation.cost_charts import SeriesPoint, draw_panels, plain_log

_WIDE = 7.0
_HIGH = 5.2
_DPI = 110
"""Width and height of a panel in inches, and resolution of the file."""
_FONT = 9
_SPREAD = 20
"""Ratio of costs above which their axis is logarithmic."""


def plot(experiment: Experiment, run: Run, path: Path) -> None:
    """Draw a run into a PNG file."""
    rows = rows_of(experiment, run)
    has_sizes = any(row.point.size is not None for row in rows)
    draw = _draw_growth if has_sizes else _draw_errors if experiment.error else _draw_bars
    with drawing():
        figure = draw(experiment, rows)
        figure.suptitle(experiment.title, fontsize=_FONT + 3)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Software": None})


def _panels(count: int, high: float = _HIGH) -> tuple[Figure, Sequence[Any]]:
    figure = Figure(figsize=(_WIDE * count, high), dpi=_DPI, layout="constrained")
    panels = figure.subplots(1, count, squeeze=False)
    for axes in panels[0]:
        axes.grid(alpha=0.25)
        axes.tick_params(labelsize=_FONT - 1)
    return figure, panels[0]


def _draw_growth(experiment: Experiment, rows: Sequence[Row]) -> Figure:
    """Draw each cost against the size in a panel, with a line for each kind."""
    costs = (experiment.cost.name, *experiment.also_cost)
    figure, panels = _panels(len(costs))
    for axes, cost in zip(panels, costs, strict=True):
        lines = defaultdict[str, list[tuple[float, float]]](list)
        for row in rows:
            if row.point.size is not None and row.values.get(cost, 0) > 0:
                lines[row.point.kind].append((row.point.size, row.values[cost]))
        for kind, at in lines.items():
            axes.plot(*zip(*sorted(at), strict=True), marker="o", markersize=4, label=kind)
        for axis, set_scale in ((axes.xaxis, axes.set_xscale), (axes.yaxis, axes.set_yscale)):
            set_scale("log")
            plain_log(axis)
        axes.set_title(cost, fontsize=_FONT + 1)
        axes.set_xlabel("size", fontsize=_FONT)
        axes.legend(fontsize=_FONT - 1)
    return figure


def _draw_errors(experiment: Experiment, rows: Sequence[Row]) -> Figure:
    """Draw errors against costs, each group in a panel and each kind in a color."""
    assert experiment.error is not None
    error = experiment.error.name
    costs = (experiment.cost.name, *experiment.also_cost)
    groups = defaultdict[str, list[SeriesPoint]](list)
    for row in rows:
        if error in row.values:
            kind = row.point.kind or "setting"
            values = [row.values[cost] for cost in costs]
            name = row.point.name.removeprefix(f"{row.point.group}, ")
            groups[row.point.group].append(
                SeriesPoint(name=name, kind=kind, costs=values, error=row.values[error])
            )
    figure, panels = _panels(len(groups))
    for axes, group in zip(panels, groups, strict=True):
        axes.set_title(group, fontsize=_FONT + 1)
        axes.set_ylabel(f"{error}, {experiment.better} is better", fontsize=_FONT)
        axes.set_xlabel(costs[0] if len(costs) == 1 else "cost", fontsize=_FONT)
    draw_panels(figure, panels, list(groups.values()), costs)
    return figure


def _draw_bars(experiment: Experiment, rows: Sequence[Row]) -> Figure:
    """Draw the cost of each point as a bar, with its range over the trials."""
    figure, (axes,) = _panels(1, high=1.4 + 0.28 * len(rows))
    costs = [row.values[experiment.cost.name] for row in rows]
    ends = [row.cost_range or (cost, cost) for row, cost in zip(rows, costs, strict=True)]
    lows = [max(0.0, cost - low) for cost, (low, _) in zip(costs, ends, strict=True)]
    highs = [max(0.0, high - cost) for cost, (_, high) in zip(costs, ends, strict=True)]
    axes.barh([row.point.name for row in rows], costs, xerr=[lows, highs], ecolor="grey")
    axes.invert_yaxis()
    axes.set_xlabel(experiment.cost.name, fontsize=_FONT)
    if max(costs) > _SPREAD * min(costs):
        axes.set_xscale("log")
        plain_log(axes.xaxis)
    return figure
