"""Fits pipeline/renders/stated_errors.json on the rows of `trilight bench calibration`.

    python -m infra.bench.stated_errors [ROWS]

Weights and shifts come from the layouts for fitting and calibration: each of them calibrates
weights that were fitted without it. The other half of the layouts judges what they gave.

Rows of an unfinished run count.
"""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from infra.bench.experiment import read_runs
from infra.bench.experiments.calibration import LOOKS, use_of
from infra.bench.run_benchmark import ROOT
from pipeline.renders.calibrated_error import (
    FILE,
    LEAST_ERROR,
    MEASURES,
    METRICS,
    CalibratedStatement,
    JudgedShare,
    MetricStatement,
    group_of,
    terms_of,
    versions_of_pictures,
)
from pipeline.renders.noise_floor import ErrorMeasures
from storage.atomic import write_atomically
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.markdown import table

Values = NDArray[np.float64]

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
    px: int
    figures: Mapping[str, float]

    @property
    def use(self) -> str:
        """The use of its layout: `fit`, `calibrate` or `judge`."""
        return use_of(self.layout)

    def measures(self, metric: str) -> ErrorMeasures:
        """Return the measures of its picture in a metric."""
        errors = {name: self.figures[f"{metric}_{name}"] * 1e-6 for name in MEASURES}
        share = self.figures[f"{metric}_block_agreement"]
        return ErrorMeasures(**errors, block_agreement=share, hits=self.figures["hits"])


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


def fit_weights(metric: str, looks: Sequence[Look]) -> MetricStatement:
    """Return a statement without shifts by a ridge regression, weights of errors at least 0.

    Few rows give the geometric mean of MEASURES. Rows weigh less the less their true error is
    known.
    """
    rows = [terms_of(look.measures(metric), look.px, look.figures["spp"]) for look in looks]
    names = list(rows[0])
    design = np.array([[row[name] for name in names] for row in rows])
    ratio = [look.figures[f"{metric}_open"] / look.figures[f"{metric}_true"] for look in looks]
    weight = 1 / (0.5 + np.square(10 * np.log10(1 + np.array(ratio))))
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
    return MetricStatement(
        intercept=middle - float(solution @ center),
        weights=dict(zip(names, map(float, solution), strict=True)),
        bound={},
        expected={},
        judged={},
    )


def stated_by(metric: str, statement: MetricStatement, looks: Sequence[Look]) -> Values:
    """Return the bound of each look in dB; of a statement without shifts its center."""
    return np.array(
        [
            statement.center_db(look.measures(metric), look.px, look.figures["spp"])
            + (statement.bound[group_of(look.px)] if statement.bound else 0.0)
            for look in looks
        ]
    )


def cross_fitted(metric: str, looks: Sequence[Look]) -> Values:
    """Return of each look what weights say that were fitted on other layouts, in dB."""
    folds = _layout_numbers(looks) % _FOLDS
    stated = np.zeros(len(looks))
    for fold in np.unique(folds):
        mine = folds == fold
        fitted = fit_weights(metric, list(compress(looks, ~mine)))
        stated[mine] = stated_by(metric, fitted, list(compress(looks, mine)))
    return stated


def _layout_numbers(looks: Sequence[Look]) -> NDArray[np.int64]:
    """Return the number of each look's layout, counted from 0 in the order of the layouts."""
    numbers: NDArray[np.int64] = np.unique([look.layout for look in looks], return_inverse=True)[1]
    return numbers


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
    layouts = _layout_numbers(looks)
    truth = true_db(metric, looks)

    def risk(shift: float) -> float:
        stated = stated_db + shift
        wrong = stated - truth > 1
        risks = [
            np.mean(np.bincount(layouts[at], wrong[at]) / np.bincount(layouts[at]))
            for at in (np.arange(len(looks)), stops(metric, looks, stated))
        ]
        return float(max(risks))

    return next((float(shift) for shift in _GRID_DB if risk(shift) <= allowed), float(_GRID_DB[-1]))


def judge(metric: str, looks: Sequence[Look], stated_db: Values) -> JudgedShare:
    """Return how often statements are wrong."""
    excess = stated_db - true_db(metric, looks)
    return JudgedShare(
        pictures=len(looks),
        layouts=len({look.layout for look in looks}),
        over_1=round(float((excess > 1).mean()), 4),
        over_3=round(float((excess > 3).mean()), 4),
        caution_db=round(float(np.median(-excess)), 2),
    )


def fit_metric(metric: str, looks: Sequence[Look]) -> MetricStatement:
    """Return the statement of a metric, fitted and calibrated on the looks that do not judge."""
    mine = [look for look in filter_known(metric, looks) if look.use != "judge"]
    fitted = fit_weights(metric, mine)
    crossed = cross_fitted(metric, mine)
    misses = true_db(metric, mine) - crossed
    groups = np.array([group_of(look.px) for look in mine])
    bound = {}
    expected = {}
    for group, allowed in ALLOWED[metric].items():
        if (at := groups == group).any():
            shift = largest_shift(metric, list(compress(mine, at)), crossed[at], allowed)
            bound[group] = round(shift, 3)
            expected[group] = round(float(np.median(misses[at])), 3)
    statement = replace(
        fitted,
        intercept=round(fitted.intercept, 4),
        weights={name: round(value, 4) for name, value in fitted.weights.items()},
        bound=bound,
        expected=expected,
    )
    judging = [look for look in filter_known(metric, looks) if look.use == "judge"]
    judged = {
        str(px): judge(metric, some, stated_by(metric, statement, some))
        for px in LOOKS
        if (some := [look for look in judging if look.px == px])
    }
    return replace(statement, judged=judged)


ROWS = ROOT / "docs" / "results" / "stated-errors.jsonl"

_LEAST_LAYOUTS = 8
"""Fewest layouts for fitting and calibration, one a fold."""


def read_looks(path: Path) -> list[Look]:
    """Return the rows of all runs of a file whose pictures are those of this Trilight.

    Raises:
        TrilightError: it has too few.
    """
    versions = versions_of_pictures().items()
    looks = {}
    for run in read_runs(path):
        if not versions <= run.plan["machine"]["versions"].items():
            continue
        for trial in run.whole_trials():
            layout = int(trial.split(",")[0].split()[1])
            for point, figures in run.trials[trial].items():
                if figures:
                    px = int(point.split()[0])
                    looks[trial, point] = Look(layout=layout, px=px, figures=figures)
    layouts = {look.layout for look in looks.values() if look.use != "judge"}
    if len(layouts) < _LEAST_LAYOUTS:
        raise TrilightError(
            f"{path}: it has {len(layouts)} layouts for fitting whose pictures have the versions "
            f"{dict(versions)}; expected {_LEAST_LAYOUTS}. Run `trilight bench calibration`."
        )
    return list(looks.values())


def main(words: Sequence[str]) -> None:
    """Fit, write the file, and print what the other layouts say of it."""
    rows = Path(words[0]) if words else ROWS
    looks = read_looks(rows)
    fitting = {look.layout for look in looks if look.use != "judge"}
    samples = [int(look.figures["spp"]) for look in looks]
    widths = [look.px for look in looks]
    statement = CalibratedStatement(
        rows=rows.name,
        rows_sha256=sha256_hex(rows.read_bytes()),
        layouts=len(fitting),
        versions=versions_of_pictures(),
        # a choice of tiles may exceed a look's samples a little
        spp=(min(samples), 32 * math.ceil((max(samples) + 1) / 32)),
        widths=(min(widths), max(widths)),
        metrics={metric: fit_metric(metric, looks) for metric in METRICS},
    )
    text = json.dumps(asdict(statement), indent=1, sort_keys=True)
    write_atomically(FILE, f"{text}\n".encode())
    records = [
        (metric, f"{px} px", f"{100 * each.over_1:.1f}", f"{100 * each.over_3:.1f}",
         f"{each.caution_db:.1f}")
        for metric, fitted in statement.metrics.items()
        for px, each in fitted.judged.items()
    ]  # fmt: skip
    head = ("error", "width", "over 1 dB worse than stated, %", "over 3 dB, %", "caution, dB")
    sys.stdout.write(f"{table(head, records)}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
