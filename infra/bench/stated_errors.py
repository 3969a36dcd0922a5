"""Fits pipeline/renders/stated_errors.json on the rows of `trilight bench calibration`.

    python -m infra.bench.stated_errors [ROWS]

Weights and shifts come from the layouts for fitting and calibration: each of them calibrates
weights that were fitted without it. The other half of the layouts judges what they gave.

It also writes the tables of docs/results/stated-errors.md, below the line that names this command.
Rows of an unfinished run count.
"""

import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from infra.bench.experiment import Store
from infra.bench.experiments.calibration import use_of
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
from storage.metrics import mean_interval

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


def shifts_of(metric: str, looks: Sequence[Look], stated_db: Values) -> dict[str, float]:
    """Return the `largest_shift` of each of GROUPS that has looks."""
    shifts = {}
    for group in GROUPS:
        at = [row for row, look in enumerate(looks) if group_of(look.px) == group]
        if at:
            some = [looks[row] for row in at]
            shifts[group] = largest_shift(metric, some, stated_db[at], ALLOWED[metric][group])
    return shifts


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
    bound = shifts_of(metric, mine, crossed)
    groups = np.array([group_of(look.px) for look in mine])
    misses = true_db(metric, mine) - crossed
    statement = MetricStatement(
        intercept=round(intercept, 4),
        weights={name: round(value, 4) for name, value in weights.items()},
        bound={group: round(shift, 3) for group, shift in bound.items()},
        expected={group: round(float(np.median(misses[groups == group])), 3) for group in bound},
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


ROWS = ROOT / "docs" / "results" / "stated-errors.jsonl"
PAGE = ROOT / "docs" / "results" / "stated-errors.md"
COMMAND = "`python -m infra.bench.stated_errors`"

_BERNSTEIN = 0.05
_LEAST_LAYOUTS = 8
"""Fewest layouts for fitting and calibration, one a fold."""


def read_looks(path: Path) -> list[Look]:
    """Return the rows of all runs of a file whose pictures are those of this Trilight.

    Raises:
        TrilightError: it has too few.
    """
    versions = versions_of_pictures().items()
    looks = {}
    for run in Store(path).runs():
        if not versions <= run.plan["machine"]["versions"].items():
            continue
        for trial in run.whole_trials():
            layout, source, family, kind, _ = trial.split(", ")
            for point, figures in run.trials[trial].items():
                if not figures:
                    continue
                look = Look(
                    layout=int(layout.split()[1]),
                    source=source,
                    family=family,
                    kind=kind,
                    px=int(point.split()[0]),
                    figures=figures,
                )
                looks[trial, point] = look
    layouts = {look.layout for look in looks.values() if look.use != "judge"}
    if len(layouts) < _LEAST_LAYOUTS:
        raise TrilightError(
            f"{path}: it has {len(layouts)} layouts for fitting whose pictures have the versions "
            f"{dict(versions)}; expected {_LEAST_LAYOUTS}. Run `trilight bench calibration`."
        )
    return list(looks.values())


def main(words: Sequence[str]) -> None:
    """Fit, judge, and write both files."""
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
    tables = "\n".join(_tables(looks))
    sys.stdout.write(f"{tables}\n")
    if PAGE.is_file():
        head, _, _ = PAGE.read_text().partition(f"Made by {COMMAND}")
        write_atomically(PAGE, f"{head}Made by {COMMAND}\n\n{tables}\n".encode())


def _db(figure: str, metric: str, look: Look, least: float = 0.0) -> float:
    error = max(look.figures[f"{metric}_{figure}"], least) * 1e-6
    return -10 * math.log10(max(error, LEAST_ERROR))


def _unbiased_db(figure: str) -> Callable[[str, Look], float]:
    """Return a statement of an unbiased figure: at least a quarter of the agreement."""
    return lambda metric, look: _db(figure, metric, look, look.figures[f"{metric}_agreement"] / 4)


def _bernstein(metric: str, look: Look) -> float:
    """Return Maurer and Pontil's bound (2009) over the blocks of the estimate, at 95 %."""
    blocks = (look.px // 8) ** 2
    values = {
        name: look.figures[f"{metric}_{name}"] for name in ("estimate", "se", "least", "most")
    }
    sure = math.log(2 / _BERNSTEIN)
    bound = max(values["estimate"], 0.0) + values["se"] * math.sqrt(2 * sure)
    bound += 7 * (values["most"] - values["least"]) * sure / (3 * (blocks - 1))
    return -10 * math.log10(max(bound * 1e-6, LEAST_ERROR))


def _relative(metric: str, look: Look) -> float:
    return -20 * math.log10(max(look.figures["relative"] * 1e-3, 1e-5))


ESTIMATORS: dict[str, Callable[[str, Look], float]] = {
    "bound": lambda metric, look: look.figures[f"bound_{metric}"],
    "cross-half estimate": _unbiased_db("estimate"),
    "SURE": _unbiased_db("sure_1"),
    "jackknife of four passes (64 samples)": lambda metric, look: _db("jackknife", metric, look),
    "empirical Bernstein": _bernstein,
    "agreement of the halves + 6 dB": lambda metric, look: _db("agreement", metric, look),
    "Mitsuba's threshold": _relative,
    "oracle: three other images (64 samples)": lambda metric, look: _db("oracle", metric, look),
}
"""Statements in dB that need no fit, without a shift."""

_SIX = "six measures"
_ONE_LOOK = ("jackknife", "oracle")
"""Beginnings of the names of those that are known at 64 samples alone."""


def _more_terms(metric: str, look: Look) -> dict[str, float]:
    """Return the terms of the statement of eleven measures."""
    more = {name: _db(name, metric, look) for name in ("raw", "fast", "most")}
    more["estimate at 2 px"] = _unbiased_db("estimate_2")(metric, look)
    more["bound"] = look.figures[f"bound_{metric}"]
    return {**more, **six_terms(metric, look)}


def _calibrate(
    metric: str, name: str, mine: Sequence[Look], judging: Sequence[Look]
) -> tuple[list[Look], Values]:
    """Return the looks that judge a statement, and what it states once it has its shifts."""
    if name in ESTIMATORS:
        if name.startswith(_ONE_LOOK):
            mine, judging = (
                [look for look in looks if look.figures["spp"] == 64] for looks in (mine, judging)
            )
        center, stated = (_state(metric, name, looks) for looks in (mine, judging))
    else:
        terms = six_terms if name == _SIX else _more_terms
        center = cross_fitted(metric, mine, terms)
        stated = apply_weights(metric, fit_weights(metric, mine, terms), judging, terms)
    shifts = shifts_of(metric, mine, center)
    return list(judging), stated + [shifts.get(group_of(look.px), 0.0) for look in judging]


def _state(metric: str, name: str, looks: Sequence[Look]) -> Values:
    return np.array([ESTIMATORS[name](metric, look) for look in looks])


def _cells(
    metric: str,
    looks: Sequence[Look],
    stated: Values,
    rows: Iterable[int] | None = None,
    *,
    intervals: bool = True,
) -> list[str]:
    """Return the record of some rows of a statement, by default of all, for each width."""
    rows = list(range(len(looks)) if rows is None else rows)
    cells = []
    for px in (64, 128, 256):
        at = [row for row in rows if looks[row].px == px]
        if not at:
            cells.append("n/a")
            continue
        judged = judge(metric, [looks[row] for row in at], stated[at])
        low, high = judged.interval
        interval = f" ({100 * low:.1f} to {100 * high:.1f})" if intervals else ""
        cells.append(
            f"{100 * judged.over_1:.1f}{interval}; {100 * judged.over_3:.1f}; "
            f"{judged.caution_db:.1f}"
        )
    return cells


def _table(title: str, first: str, cells: Mapping[str, Sequence[str]]) -> str:
    rows = [(name, *each) for name, each in cells.items()]
    return f"\n{title}\n\n{table((first, '64 px', '128 px', '256 px'), rows)}"


def _tables(looks: Sequence[Look]) -> Iterator[str]:
    uses = Counter(use_of(layout) for layout in {look.layout for look in looks})
    yield (
        f"{len(looks)} images of {uses.total()} layouts: {uses['fit'] + uses['calibrate']} fit and "
        f"calibrate, {uses['judge']} judge. Cells: share over 1 dB worse than stated in %, with "
        "its 95 % interval over layouts; share over 3 dB in %; median caution in dB."
    )
    for metric in ("log", "linear"):
        counted = filter_known(metric, looks)
        mine = [look for look in counted if look.use != "judge"]
        judging = [look for look in counted if look.use == "judge"]
        left_out = 100 - 100 * len(counted) / len(looks)
        yield f"\n## {metric.capitalize()} error\n"
        yield f"{left_out:.0f} % of the images are left out: the reference leaves too much open."
        yield _table(
            "Every statement with the shifts that keep its risk on the first layouts:",
            "statement",
            {
                name: _cells(metric, *_calibrate(metric, name, mine, judging))
                for name in (*ESTIMATORS, _SIX, "eleven measures")
            },
        )
        yield _table(
            "Statements as their authors have them:",
            "statement",
            {
                name: _cells(metric, judging, _state(metric, name, judging))
                for name in ESTIMATORS
                if not name.startswith(("Mitsuba", *_ONE_LOOK))
            },
        )
        yield from _parts(metric, mine, judging)


_GROUPINGS: dict[str, Callable[[Look], str]] = {
    "source": lambda look: look.source,
    "layout": lambda look: look.family.partition("-")[0],
    "kind": lambda look: look.kind,
    "width": lambda look: f"{look.px} px",
}
"""Groups of pictures that are left out in turn; all but the last have records of their own."""


def _parts(metric: str, mine: Sequence[Look], judging: Sequence[Look]) -> Iterator[str]:
    """Yield the record of the six measures by kind of picture, and under shifts."""
    some, stated = _calibrate(metric, _SIX, mine, judging)
    cells = {}
    for label, group in [*_GROUPINGS.items()][:-1]:
        for value in sorted({group(look) for look in some}):
            at = [row for row, look in enumerate(some) if group(look) == value]
            cells[f"{label} {value}"] = _cells(metric, some, stated, at, intervals=False)
    at = stops(metric, some, stated)
    cells["where sampling stops"] = _cells(metric, some, stated, at, intervals=False)
    yield _table("Six measures, by kind of image:", "images", cells)
    cells = {}
    both = [*mine, *judging]
    for label, group in _GROUPINGS.items():
        for value in sorted({group(look) for look in both}):
            rest = [look for look in mine if group(look) != value]
            if len({look.layout for look in rest}) >= _LEAST_LAYOUTS:
                alike = [look for look in both if group(look) == value]
                calibrated = _calibrate(metric, _SIX, rest, alike)
                cells[f"{label} {value}"] = _cells(metric, *calibrated, intervals=False)
    title = "Fitted and calibrated without the images that are judged, under a shift:"
    yield _table(title, "left out", cells)


if __name__ == "__main__":
    main(sys.argv[1:])
