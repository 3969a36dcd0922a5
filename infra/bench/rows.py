"""Table of a run, a row for each point with its Pareto front, and its plot."""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from infra.bench.experiment import Column, Experiment, Point, Run, columns_of
from pipeline.documents.figures import drawing
from storage.errors import TrilightError
from storage.metrics import mean_interval
from train.evaluation.cost_charts import SeriesPoint, draw_panels, number_text, on_front, plain_log

_OVER: Mapping[str, Callable[[Sequence[float]], Any]] = {
    "median": np.median,
    "mean": np.mean,
    "pair": np.mean,
    "least": np.min,
    "most": np.max,
    "p5": lambda values: np.percentile(values, 5),
}
_WIDE = 7.0
_HIGH = 5.2
_DPI = 110
"""Width and height of a panel in inches, and resolution of the file."""

_FONT = 9
_SPREAD = 20
"""Ratio of costs above which their axis is logarithmic."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Row of the table: one point with its values."""

    point: Point
    """Declaration of the point, without its settings."""
    values: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]
    """95 % interval of each column over `pair`, by name."""
    cost_range: tuple[float, float] | None
    """Smallest and largest cost over the trials; None for a single trial."""
    on_front: bool | None = None
    """True on the Pareto front of its group; None without an error, and for a yardstick."""


def rows_of(experiment: Experiment, run: Run) -> list[Row]:
    """Return the measured points of a run in their declared order.

    Raises:
        TrilightError: the run is of another experiment, or nothing was measured.
    """
    if run.plan["experiment"] != experiment.name:
        raise TrilightError(
            f"bench {experiment.name}: the file holds results of {run.plan['experiment']!r}; "
            "expected one experiment a file. Name another one by --out."
        )
    rows = [_row(experiment, run, Point(**record)) for record in run.plan["points"]]
    known = [row for row in rows if row.values.get(experiment.cost.name, 0) > 0]
    if not known:
        raise TrilightError(f"bench {experiment.name}: no point was measured; run it again.")
    front = _front(experiment, known)
    return [dataclasses.replace(row, on_front=front.get(row.point.name)) for row in known]


def table_of(experiment: Experiment, run: Run) -> Iterator[list[str]]:
    """Yield the headings, and the cells of every point with the range of its cost."""
    rows = rows_of(experiment, run)
    columns = columns_of(experiment)
    has_front = experiment.error is not None and any(row.on_front is not None for row in rows)
    yield ["setting", *(column.name for column in columns), *(["front"] if has_front else [])]
    for row in rows:
        name = f"{row.point.name} *" if row.point.default else row.point.name
        front = {True: "yes", False: "no", None: "n/a"}[row.on_front]
        cells = [_cell(column, row) for column in columns]
        if row.cost_range:
            cells[0] += f" ({' to '.join(map(number_text, row.cost_range))})"
        yield [name, *cells, *([front] if has_front else [])]


def _cell(column: Column, row: Row) -> str:
    """Return one cell: decibels with one decimal, n/a for an unknown value."""
    value = row.values.get(column.name)
    if value is None:
        return "" if column.over == "pair" else "n/a"
    if column.name in row.intervals:
        low, high = row.intervals[column.name]
        return f"{value:+.1f} ({low:.1f} to {high:.1f})"
    return f"{value:.1f}" if "dB" in column.name else number_text(value)


def _row(experiment: Experiment, run: Run, point: Point) -> Row:
    """Return a point with the values of its columns, before fronts are known."""
    values = {}
    intervals = {}
    for column in columns_of(experiment):
        figures = _figures(column, run, point)
        if not figures:
            continue
        taken = list(figures.values())
        interval = mean_interval(taken, [experiment.cluster(trial) for trial in figures])
        if column.over == "pair":
            intervals[column.name] = interval
        if column.over in ("low", "high"):
            value = interval[column.over == "high"]
        else:
            value = float(_OVER[column.over](taken))
        values[column.name] = column.then(value)
    costs = _figures_by_trial(experiment.cost, run, point.name).values()
    ordered = sorted(map(experiment.cost.then, costs))
    cost_range = (ordered[0], ordered[-1]) if len(ordered) > 1 else None
    return Row(point=point, values=values, intervals=intervals, cost_range=cost_range)


def _figures(column: Column, run: Run, point: Point) -> dict[str, float]:
    """Return the figures of a column by trial; over `pair` minus those of the point's rival."""
    mine = _figures_by_trial(column, run, point.name)
    if column.over != "pair":
        return mine
    theirs = _figures_by_trial(column, run, point.rival) if point.rival else {}
    return {trial: mine[trial] - theirs[trial] for trial in mine if trial in theirs}


def _figures_by_trial(column: Column, run: Run, point: str) -> dict[str, float]:
    trials = {trial: run.trials[trial][point] for trial in run.whole_trials()}
    return {trial: row[column.figure] for trial, row in trials.items() if column.figure in row}


def _front(experiment: Experiment, known: Sequence[Row]) -> dict[str, bool]:
    """Return by name whether a point is on the Pareto front of its group."""
    if experiment.error is None:
        return {}
    error = experiment.error.name
    sign = -1 if experiment.better == "higher" else 1
    costs = (experiment.cost.name, *experiment.also_cost)
    groups = defaultdict[str, list[Row]](list)
    for row in known:
        if row.point.judged and error in row.values:
            groups[row.point.group].append(row)
    front = dict[str, bool]()
    for rows in groups.values():
        marks = on_front(
            [(sign * row.values[error], [row.values[cost] for cost in costs]) for row in rows]
        )
        front |= zip([row.point.name for row in rows], marks, strict=True)
    return front


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
