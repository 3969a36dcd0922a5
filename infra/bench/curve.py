"""The points of a run as a table's rows: columns, spread, cost ratio, and whether on the front."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from infra.bench.effort import CAREFUL, QUICK, Effort
from infra.bench.experiment import Column, Experiment, Point
from infra.bench.store import Run
from storage.errors import TrilightError
from storage.intervals import mean_interval

COST_NOISE = 0.03
"""Costs that differ by less than this share count as equal: core-seconds vary by that much."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """One figure over the turns."""

    median: float
    """What to quote."""
    low: float
    """The smallest."""
    high: float
    """The largest."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One point beside the others."""

    point: Point
    """The point's declaration."""
    values: Mapping[str, float]
    """Value of each measured column, by name."""
    cost_ratio: float
    """The point's cost divided by the default's."""
    intervals: Mapping[str, tuple[float, float]]
    """The 95 % interval of each column over `pair`, by name."""
    cost_spread: Spread | None
    """The cost over the turns; None where it was not kept or there was one turn."""
    on_front: bool | None
    """Whether no other point dominates it (`on_front`); None without an error, and for what is no
    choice."""


def rows(experiment: Experiment, run: Run) -> list[Row]:
    """Return the points of a run in their declared order, without those it did not measure.

    Raises:
        TrilightError: nothing was measured, or the default was not.
    """
    points = {point.name: point for point in experiment.points(_effort(run))}
    known = [points.get(name, Point(name=name)) for name in run.plan["points"]]
    values = {point.name: _values(experiment, run, point.name) for point in known}
    known = [point for point in known if experiment.cost.name in values[point.name]]
    base = values[_base(experiment, known).name][experiment.cost.name]
    front = _front(experiment, known, values)
    return [
        Row(
            point=point,
            values=values[point.name],
            cost_ratio=values[point.name][experiment.cost.name] / base,
            intervals=_intervals(experiment, run, point.name),
            cost_spread=_cost_spread(experiment, run, point.name),
            on_front=front.get(point.name),
        )
        for point in known
    ]


def columns_of(experiment: Experiment) -> tuple[Column, ...]:
    """Return the columns of a table: cost, error where there is one, and the further ones."""
    error = (experiment.error,) if experiment.error else ()
    return (experiment.cost, *error, *experiment.columns)


def on_front(figures: Sequence[tuple[float, Sequence[float]]]) -> list[bool]:
    """Return which of some points no other one dominates.

    One with less error dominates where none of its costs is more than COST_NOISE higher; one with
    the same error where none is higher and one is more than COST_NOISE lower. Some point always
    remains, since a dominating point has less error, or the same error and less cost.

    Args:
        figures: error (smaller is better) and costs above 0 of each point, equally many.
    """
    return [not any(_dominates(other, mine) for other in figures) for mine in figures]


def spread(values: Sequence[float]) -> Spread:
    """Return median, smallest and largest of the figures of all turns."""
    return Spread(median=float(np.median(values)), low=min(values), high=max(values))


_OVER: Mapping[str, Callable[[Sequence[float]], Any]] = {
    "median": np.median,
    "mean": np.mean,
    "pair": np.mean,
    "least": np.min,
    "most": np.max,
    "p5": lambda values: np.percentile(values, 5),
    "p95": lambda values: np.percentile(values, 95),
}


def _effort(run: Run) -> Effort:
    asked = run.plan["effort"]
    base = QUICK if asked["name"] == QUICK.name else CAREFUL
    known: dict[str, Any] = {
        key: tuple(x) if isinstance(x, list) else x for key, x in asked.items()
    }
    return dataclasses.replace(base, **known)


def _base(experiment: Experiment, known: Sequence[Point]) -> Point:
    defaults = [point for point in known if point.default]
    if not known or len(defaults) > 1:
        raise TrilightError(
            f"experiment {experiment.name}: {len(known)} points were measured, {len(defaults)} of "
            "them the default; expected one point or more and at most one default. Run it again."
        )
    return (defaults or known)[0]


def _values(experiment: Experiment, run: Run, point: str) -> dict[str, float]:
    whole = run.whole_turns()
    turns = [run.turns[turn][point] for turn in whole]
    clusters = [experiment.cluster(turn) for turn in whole]
    found = dict(run.columns.get(point, {}))
    for column in columns_of(experiment):
        figures = (
            _differences(column, run, point)[0]
            if column.over == "pair"
            else [turn[column.figure] for turn in turns if column.figure in turn]
        )
        if figures:
            value = _over(column, figures, clusters)
            found[column.name] = column.then(value) if column.then else value
    return found


def _differences(column: Column, run: Run, point: str) -> tuple[list[float], list[str]]:
    """Return a point's figures less the rival's, with the turns that have both.

    There are none of the rival itself.
    """
    rival, name = run.plan.get("rival", point), column.figure
    if rival == point:
        return [], []
    turns = {turn: run.turns[turn] for turn in run.whole_turns()}
    both = [turn for turn, of in turns.items() if name in of[point] and name in of[rival]]
    return [turns[turn][point][name] - turns[turn][rival][name] for turn in both], both


def _intervals(experiment: Experiment, run: Run, point: str) -> dict[str, tuple[float, float]]:
    found = {}
    for column in columns_of(experiment):
        if column.over == "pair":
            differences, turns = _differences(column, run, point)
            if differences:
                clusters = [experiment.cluster(turn) for turn in turns]
                found[column.name] = mean_interval(differences, clusters)
    return found


def _over(column: Column, figures: Sequence[float], clusters: Sequence[str]) -> float:
    if column.over in ("low", "high"):
        return mean_interval(figures, clusters)[column.over == "high"]
    return float(_OVER[column.over](figures))


def _cost_spread(experiment: Experiment, run: Run, point: str) -> Spread | None:
    column = experiment.cost
    figures = [run.turns[turn][point][column.figure] for turn in run.whole_turns()]
    if len(figures) < 2:
        return None
    return spread([column.then(value) if column.then else value for value in figures])


def _front(
    experiment: Experiment, known: Sequence[Point], values: Mapping[str, Mapping[str, float]]
) -> dict[str, bool]:
    if experiment.error is None:
        return {}
    error, sign = experiment.error.name, -1 if experiment.better == "higher" else 1
    costs = (experiment.cost.name, *experiment.also_cost)
    choices = [point.name for point in known if point.judged and error in values[point.name]]
    figures = [
        (sign * values[name][error], [values[name][cost] for cost in costs]) for name in choices
    ]
    return dict(zip(choices, on_front(figures), strict=True))


def _dominates(other: tuple[float, Sequence[float]], mine: tuple[float, Sequence[float]]) -> bool:
    costs = list(zip(other[1], mine[1], strict=True))
    if other[0] < mine[0]:
        return all(a <= (1 + COST_NOISE) * b for a, b in costs)
    lower = any((1 + COST_NOISE) * a < b for a, b in costs)
    return other[0] == mine[0] and lower and all(a <= b for a, b in costs)


@dataclass(frozen=True, kw_only=True)
class PricedLevel:
    """A path tracer at one number of samples."""

    spp: float
    """Samples per pixel."""
    core_s: float
    """Core-seconds."""
    db: float
    """psnr_log_db to the reference."""


def at_error(levels: Sequence[PricedLevel], db: float) -> tuple[PricedLevel, bool]:
    """Return the level at which a path tracer first has an error of `db`, and whether it has it.

    Between two levels dB are taken linear in log2 of the samples, and core-seconds linear in the
    samples. Outside of what was measured the nearest level is returned, with False: its cost is a
    lower bound where no level is good enough, and an upper one where all are better.

    Args:
        levels: rising in samples; one at least.
        db: psnr_log_db that is asked for, to the same reference.
    """
    row = next((row for row, level in enumerate(levels) if level.db >= db), None)
    if row is None:
        return levels[-1], False
    above = levels[row]
    if row == 0:
        return above, above.db == db
    below = levels[row - 1]
    share = (db - below.db) / (above.db - below.db)
    spp = below.spp * 2 ** (share * math.log2(above.spp / below.spp))
    slope = (above.core_s - below.core_s) / (above.spp - below.spp)
    return PricedLevel(spp=spp, core_s=below.core_s + slope * (spp - below.spp), db=db), True
