"""Fits pipeline/renders/stated_errors.json on the rows of `trilight bench calibration`.

    python -m infra.bench.stated_errors [ROWS]

It also writes the tables of docs/results/stated-errors.md, below the line that names this command.
Rows of an unfinished run count.
"""

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from infra.bench.experiments.calibration import use_of
from infra.bench.run_benchmark import ROOT
from infra.bench.store import Store
from infra.bench.workloads.fitted_statement import (
    ALLOWED,
    GROUPS,
    Look,
    Values,
    apply_weights,
    cross_fitted,
    filter_known,
    fit_metric,
    fit_weights,
    judge,
    largest_shift,
    six_terms,
    stops,
)
from pipeline.renders.calibrated_error import (
    FILE,
    LEAST_ERROR,
    METRICS,
    CalibratedStatement,
    group_of,
    versions_of_pictures,
)
from storage.atomic import write_atomically
from storage.digests import sha256_hex
from storage.errors import TrilightError

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

_ONE_LOOK = ("jackknife", "oracle")
"""Beginnings of the names of those that are known at 64 samples alone."""


def _more_terms(metric: str, look: Look) -> dict[str, float]:
    """Return the terms of the statement of eleven measures."""
    more = {name: _db(name, metric, look) for name in ("raw", "fast", "most")}
    more["estimate at 2 px"] = _unbiased_db("estimate_2")(metric, look)
    more["bound"] = look.figures[f"bound_{metric}"]
    return {**more, **six_terms(metric, look)}


def _calibrate(
    metric: str,
    name: str,
    mine: Sequence[Look],
    judging: Sequence[Look],
) -> tuple[list[Look], Values]:
    """Return the looks that judge a statement, and what it states once it has its shifts."""
    if name in ESTIMATORS:
        if name.startswith(_ONE_LOOK):
            mine, judging = (
                [look for look in looks if look.figures["spp"] == 64] for looks in (mine, judging)
            )
        one = ESTIMATORS[name]
        center = np.array([one(metric, look) for look in mine])
        stated = np.array([one(metric, look) for look in judging])
    else:
        terms = six_terms if name.startswith("six") else _more_terms
        center = cross_fitted(metric, mine, terms)
        stated = apply_weights(metric, fit_weights(metric, mine, terms), judging, terms)
    for group in GROUPS:
        at = [row for row, look in enumerate(mine) if group_of(look.px) == group]
        if not at:
            continue
        some = [mine[row] for row in at]
        shift = largest_shift(metric, some, center[at], ALLOWED[metric][group])
        stated = stated + shift * np.array([group_of(look.px) == group for look in judging])
    return list(judging), stated


def _cells(
    metric: str, looks: Sequence[Look], stated: Values, *, intervals: bool = True
) -> Iterator[str]:
    for px in (64, 128, 256):
        at = [row for row, look in enumerate(looks) if look.px == px]
        if not at:
            yield "n/a"
            continue
        judged = judge(metric, [looks[row] for row in at], stated[at])
        low, high = judged.interval
        interval = f" ({100 * low:.1f} to {100 * high:.1f})" if intervals else ""
        yield (
            f"{100 * judged.over_1:.1f}{interval}; {100 * judged.over_3:.1f}; "
            f"{judged.caution_db:.1f}"
        )


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _tables(looks: Sequence[Look]) -> Iterator[str]:
    layouts = {look.layout for look in looks}
    uses = [
        sum(use_of(layout) == use for layout in layouts) for use in ("fit", "calibrate", "judge")
    ]
    yield (
        f"{len(looks)} images of {len(layouts)} layouts: {uses[0] + uses[1]} fit and calibrate, "
        f"{uses[2]} judge. Cells: share over 1 dB worse than stated in %, with its 95 % interval "
        "over layouts; share over 3 dB in %; median caution in dB."
    )
    for metric in ("log", "linear"):
        counted = filter_known(metric, looks)
        mine = [look for look in counted if look.use != "judge"]
        judging = [look for look in counted if look.use == "judge"]
        left_out = 100 - 100 * len(counted) / len(looks)
        yield from ("", f"## {metric.capitalize()} error", "")
        yield f"{left_out:.0f} % of the images are left out: the reference leaves too much open."
        yield from (
            "",
            "Every statement with the shifts that keep its risk on the first layouts:",
            "",
        )
        yield _line("statement", "64 px", "128 px", "256 px")
        yield "|---|---|---|---|"
        for name in (*ESTIMATORS, "six measures", "eleven measures"):
            some, stated = _calibrate(metric, name, mine, judging)
            yield _line(name, *_cells(metric, some, stated))
        yield from ("", "Statements as their authors have them:", "")
        yield _line("statement", "64 px", "128 px", "256 px")
        yield "|---|---|---|---|"
        for name in ESTIMATORS:
            if not name.startswith(("Mitsuba", *_ONE_LOOK)):
                stated = np.array([ESTIMATORS[name](metric, look) for look in judging])
                yield _line(name, *_cells(metric, judging, stated))
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
    head = ["64 px", "128 px", "256 px"]
    name = "six measures"
    yield from ("", "Six measures, by kind of image:", "")
    yield _line("images", *head)
    yield "|---|---|---|---|"
    some, stated = _calibrate(metric, name, mine, judging)
    for label, group in [*_GROUPINGS.items()][:-1]:
        for value in sorted({group(look) for look in some}):
            at = [row for row, look in enumerate(some) if group(look) == value]
            yield _line(
                f"{label} {value}",
                *_cells(metric, [some[row] for row in at], stated[at], intervals=False),
            )
    at = stops(metric, some, stated)
    yield _line(
        "where sampling stops",
        *_cells(metric, [some[row] for row in at], stated[at], intervals=False),
    )
    yield from (
        "",
        "Fitted and calibrated without the images that are judged, under a shift:",
        "",
    )
    yield _line("left out", *head)
    yield "|---|---|---|---|"
    both = [*mine, *judging]
    for label, group in _GROUPINGS.items():
        for value in sorted({group(look) for look in both}):
            rest = [look for look in mine if group(look) != value]
            if len({look.layout for look in rest}) >= _LEAST_LAYOUTS:
                rest_judged, stated = _calibrate(
                    metric, name, rest, [look for look in both if group(look) == value]
                )
                yield _line(
                    f"{label} {value}", *_cells(metric, rest_judged, stated, intervals=False)
                )


if __name__ == "__main__":
    main(sys.argv[1:])
