"""Fits the statement of an error on rows of the calibration, calibrates its shifts, and judges it.

Weights and shifts come from the layouts for fitting and calibration: each of them calibrates
weights that were fitted without it. The other half of the layouts judges what they gave.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from infra.bench.experiments.calibration import use_of
from pipeline.renders.calibrated_error import (
    LEAST_ERROR,
    MEASURES,
    JudgedShare,
    MetricStatement,
    group_of,
    terms_of,
)
from pipeline.renders.noise_floor import ErrorMeasures
from storage.intervals import mean_interval

Values = NDArray[np.float64]

GROUPS = ("narrow", "medium", "wide")
ALLOWED = {
    "log": {"narrow": 0.025, "medium": 0.015, "wide": 0.015},
    "linear": {"narrow": 0.04, "medium": 0.025, "wide": 0.025},
    "object": {"narrow": 0.025, "medium": 0.015, "wide": 0.015},
}
"""Share of pictures that may be more than 1 dB worse than stated, by metric and group of widths."""

TARGETS_DB = {
    "log": (34, 36, 38, 40, 42, 44),
    "linear": (26, 28, 30, 32, 34, 36),
    "object": (32, 34, 36, 38, 40, 42),
}
"""Targets at which sampling is stopped in the calibration, in dB."""

MOST_OPEN = {64: 0.4, 128: 0.4, 256: 0.6}
"""Largest relative standard deviation of a true error that counts, by width in pixels."""

_FOLDS = 8
_RIDGE = 10.0
_GRID_DB = np.arange(4.0, -12.0, -0.05)


@dataclass(frozen=True, kw_only=True)
class Look:
    """One row of the calibration."""

    layout: int
    source: str
    family: str
    kind: str
    px: int
    figures: Mapping[str, float]

    @property
    def use(self) -> str:
        """The use of its layout: `fit`, `calibrate` or `judge`."""
        return use_of(self.layout)


Statement = Callable[[Sequence[Look]], Values]
"""Function that returns what is stated of each look, in dB, before a shift."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """How often a statement was wrong, over some looks."""

    pictures: int
    layouts: int
    over_1: float
    interval: tuple[float, float]
    over_3: float
    caution_db: float


def true_db(metric: str, looks: Sequence[Look]) -> Values:
    """Return the true error of each look in dB."""
    errors = np.array([look.figures[f"{metric}_true"] for look in looks]) * 1e-6
    db: Values = -10 * np.log10(np.maximum(errors, LEAST_ERROR))
    return db


def filter_known(metric: str, looks: Sequence[Look]) -> list[Look]:
    """Return the looks whose true error is known well enough."""
    return [
        look
        for look in looks
        if 0 < look.figures[f"{metric}_open"] <= MOST_OPEN[look.px] * look.figures[f"{metric}_true"]
    ]


def open_db(metric: str, looks: Sequence[Look]) -> Values:
    """Return how far the true error of each look is known, in dB."""
    ratio = [look.figures[f"{metric}_open"] / look.figures[f"{metric}_true"] for look in looks]
    db: Values = 10 * np.log10(1 + np.array(ratio))
    return db


def six_terms(metric: str, look: Look) -> dict[str, float]:
    """Return the terms of the product's statement, by name."""
    errors = {name: look.figures[f"{metric}_{name}"] * 1e-6 for name in MEASURES}
    share = look.figures[f"{metric}_block_agreement"]
    measures = ErrorMeasures(**errors, block_agreement=share, hits=look.figures["hits"])
    return terms_of(measures, look.px, look.figures["spp"])


def fit_weights(
    metric: str,
    looks: Sequence[Look],
    terms: Callable[[str, Look], Mapping[str, float]] = six_terms,
) -> tuple[float, dict[str, float]]:
    """Return intercept and weights by a ridge regression, weights of errors at least 0.

    Few rows give the geometric mean of MEASURES. Rows weigh less the less their true error is
    known.
    """
    rows = [terms(metric, look) for look in looks]
    names = list(rows[0])
    design = np.array([[row[name] for name in names] for row in rows])
    weight = 1 / (0.5 + np.square(open_db(metric, looks)))
    center = np.average(design, axis=0, weights=weight)
    spread = np.sqrt(np.average(np.square(design - center), axis=0, weights=weight)) + 1e-9
    target = true_db(metric, looks)
    middle = float(np.average(target, weights=weight))
    root = np.sqrt(weight)[:, None]
    ridge = np.sqrt(_RIDGE) * np.eye(len(names))
    equal = np.array([1 / len(MEASURES) if name in MEASURES else 0.0 for name in names])
    matrix = np.vstack([root * (design - center) / spread, ridge])
    values = np.concatenate([root[:, 0] * (target - middle), ridge @ (equal * spread)])
    free = ("hits", "samples", "width")
    least = [-np.inf if name in free else 0.0 for name in names]
    solution = lsq_linear(matrix, values, bounds=(least, np.inf)).x / spread
    return middle - float(solution @ center), dict(zip(names, map(float, solution), strict=True))


def apply_weights(
    metric: str,
    fitted: tuple[float, Mapping[str, float]],
    looks: Sequence[Look],
    terms: Callable[[str, Look], Mapping[str, float]] = six_terms,
) -> Values:
    """Return what fitted weights say of each look, in dB."""
    intercept, weights = fitted
    rows = [terms(metric, look) for look in looks]
    return np.array([intercept + sum(weights[name] * row[name] for name in row) for row in rows])


def cross_fitted(
    metric: str,
    looks: Sequence[Look],
    terms: Callable[[str, Look], Mapping[str, float]] = six_terms,
) -> Values:
    """Return of each look what weights say that were fitted on other layouts, in dB."""
    layouts = sorted({look.layout for look in looks})
    fold = {layout: number % _FOLDS for number, layout in enumerate(layouts)}
    stated = np.zeros(len(looks))
    for number in range(_FOLDS):
        mine = [row for row, look in enumerate(looks) if fold[look.layout] == number]
        rest = [look for look in looks if fold[look.layout] != number]
        if mine:
            fitted = fit_weights(metric, rest, terms)
            stated[mine] = apply_weights(metric, fitted, [looks[row] for row in mine], terms)
    return stated


def stops(metric: str, looks: Sequence[Look], stated_db: Values) -> list[int]:
    """Return the rows of pictures at which sampling stops, for each view and target.

    A view stops at its first look that states the target, or at its last one.
    """
    views: dict[tuple[int, int], list[int]] = {}
    for row, look in enumerate(looks):
        views.setdefault((look.layout, look.px), []).append(row)
    stopped = []
    for rows in views.values():
        ordered = sorted(rows, key=lambda row: looks[row].figures["spp"])
        for target_db in TARGETS_DB[metric]:
            reached = (row for row in ordered if stated_db[row] >= target_db)
            stopped.append(next(reached, ordered[-1]))
    return stopped


def largest_shift(metric: str, looks: Sequence[Look], stated_db: Values, allowed: float) -> float:
    """Return the largest shift in dB that keeps the risk.

    The risk is the share of pictures over 1 dB worse than stated, averaged over layouts: of all
    looks, or of those at which sampling stops, whichever is larger.
    """
    rows = np.array([look.layout for look in looks])
    layouts = sorted(set(rows.tolist()))
    truth = true_db(metric, looks)
    for shift in _GRID_DB:
        stated = stated_db + shift
        wrong = (stated - truth > 1).astype(np.float64)
        risks = []
        for chosen in (range(len(looks)), stops(metric, looks, stated)):
            at = np.array(chosen)
            by_layout = [wrong[at][rows[at] == each].mean() for each in layouts]
            risks.append(float(np.mean(by_layout)))
        if max(risks) <= allowed:
            return float(shift)
    return float(_GRID_DB[-1])


def judge(metric: str, looks: Sequence[Look], stated_db: Values) -> Judged:
    """Return how often statements are wrong, with a 95 % interval over layouts."""
    excess = stated_db - true_db(metric, looks)
    over = (excess > 1).astype(np.float64).tolist()
    clusters = [str(look.layout) for look in looks]
    return Judged(
        pictures=len(looks),
        layouts=len(set(clusters)),
        over_1=float(np.mean(over)),
        interval=mean_interval(over, clusters),
        over_3=float((excess > 3).mean()),
        caution_db=float(np.median(-excess)),
    )


def fit_metric(metric: str, looks: Sequence[Look]) -> MetricStatement:
    """Return the statement of a metric, fitted and calibrated on the looks that do not judge."""
    mine = [look for look in filter_known(metric, looks) if look.use != "judge"]
    intercept, weights = fit_weights(metric, mine)
    crossed = cross_fitted(metric, mine)
    bound = dict[str, float]()
    expected = dict[str, float]()
    for group in GROUPS:
        at = [row for row, look in enumerate(mine) if group_of(look.px) == group]
        some = [mine[row] for row in at]
        shift = largest_shift(metric, some, crossed[at], ALLOWED[metric][group])
        bound[group] = round(shift, 3)
        expected[group] = round(float(np.median(true_db(metric, some) - crossed[at])), 3)
    statement = MetricStatement(
        intercept=round(intercept, 4),
        weights={name: round(value, 4) for name, value in weights.items()},
        bound=bound,
        expected=expected,
        judged={},
    )
    return replace(statement, judged=_judge_widths(metric, statement, looks))


def stated_by(metric: str, statement: MetricStatement, looks: Sequence[Look]) -> Values:
    """Return the bound of each look in dB."""
    center = apply_weights(metric, (statement.intercept, statement.weights), looks)
    shifts: Values = np.array([statement.bound[group_of(look.px)] for look in looks])
    return center + shifts


def _judge_widths(
    metric: str, statement: MetricStatement, looks: Sequence[Look]
) -> dict[str, JudgedShare]:
    judging = [look for look in filter_known(metric, looks) if look.use == "judge"]
    records = {}
    for px in sorted({look.px for look in judging}):
        some = [look for look in judging if look.px == px]
        result = judge(metric, some, stated_by(metric, statement, some))
        records[str(px)] = JudgedShare(
            pictures=result.pictures,
            layouts=result.layouts,
            over_1=round(result.over_1, 4),
            over_3=round(result.over_3, 4),
            caution_db=round(result.caution_db, 2),
        )
    return records
