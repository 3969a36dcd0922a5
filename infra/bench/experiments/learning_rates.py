"""Learning rates by width, optimiser and schedule: what the rates of our runs rest on."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from infra.bench.effort import Effort
from infra.bench.experiment import Column, Experiment, Figures, Point, TurnFigures
from infra.bench.run import RESULTS, store_of
from infra.bench.workshop import Workshop
from storage.errors import TrilightError

if TYPE_CHECKING:
    from infra.bench.sides.rated_trainings import Amount, Optimiser
    from infra.bench.sides.short_trainings import Course

Turns = Mapping[str, Mapping[str, Figures]]
"""Figures by turn and point."""

RATES: Mapping["Optimiser", tuple[float, ...]] = {
    "AdamW": (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3),
    "Muon": (1.25e-4, 2.5e-4, 5e-4, 1e-3, 2e-3),
}
"""Peak learning rates, doubling."""

ONE_RATE, BY_WIDTH = "one rate", "by width"
RULES = {ONE_RATE: False, BY_WIDTH: True}
"""Whether rates and initial weights follow the width."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Extent:
    """How much is trained."""

    steps: int
    """Of each training."""
    widths: tuple[int, ...]
    """Of the networks whose rates are sought."""
    seeds: int
    """With which each rate is tried at each width."""
    rules: tuple[str, ...]
    """Names in RULES that rates are sought with; those of the first are compared."""
    compared_widths: tuple[int, ...]
    """Of the networks whose optimisers are compared, each at its best rate."""
    compared_seeds: int
    """With which they are."""
    held_out: int
    """Scenes of the validation split that are judged on."""
    scenes_per_step: int
    """Two views each."""
    precision: Literal["float32", "bfloat16"]
    """Of the networks' products."""


EXTENTS = {
    "quick": Extent(
        steps=200,
        widths=(64, 128, 256),
        seeds=1,
        rules=(ONE_RATE, BY_WIDTH),
        compared_widths=(64,),
        compared_seeds=4,
        held_out=32,
        scenes_per_step=2,
        precision="float32",
    ),
    "careful": Extent(
        steps=2000,
        widths=(64, 128, 256, 576),
        seeds=2,
        rules=(BY_WIDTH,),
        compared_widths=(128,),
        compared_seeds=4,
        held_out=64,
        scenes_per_step=4,
        precision="bfloat16",
    ),
}
"""By effort: 0.28 M, 1.05 M, 4.1 M and 20 M parameters; with care as `pretrain` multiplies."""

WIDTHS = EXTENTS["careful"].widths

_EXTENTS_SAID = (
    f"{EXTENTS['careful'].steps} steps of {EXTENTS['careful'].scenes_per_step} scenes in bfloat16 "
    f"(with --quick {EXTENTS['quick'].steps} of {EXTENTS['quick'].scenes_per_step} in float32)"
)
_AGAINST = "scenes of the validation split of `--data`, all their views at 32 pixels"


def extent_of(effort: Effort) -> Extent:
    """Return how much an effort trains."""
    return EXTENTS[effort.name]


def rate_name(optimiser: str, rule: str, rate: float) -> str:
    """Return what the table calls a rate."""
    return f"{optimiser} {rate:g}, {rule}"


def best_rates(extent: Extent, folder: Path = RESULTS) -> dict[tuple["Optimiser", int], float]:
    """Return the rate of least error of each optimiser at each width that is compared.

    They are of the newest run of `learning-rates` that has tried them all, ended or not.

    Raises:
        TrilightError: there is none.
    """
    for effort in ("careful", "quick"):
        for run in reversed(store_of(folder, "learning-rates", effort).runs()):
            found = {
                (optimiser, width): _best(run.turns, optimiser, width, extent.rules[0])
                for optimiser in RATES
                for width in extent.compared_widths
            }
            if known := {key: rate for key, rate in found.items() if rate is not None}:
                if len(known) == len(found):
                    return known
    raise TrilightError(
        "bench optimisers: each is compared at its best rate, and no result of `trilight bench "
        "learning-rates` has tried all of them; run that first, with the same --data."
    )


def _best(turns: Turns, optimiser: "Optimiser", width: int, rule: str) -> float | None:
    """Return the rate of least mean error over the seeds; None where one was not tried."""
    tried = [points for turn, points in turns.items() if _width_and_seed(turn)[0] == width]
    errors = {
        rate: [points[name].get("log_l1", math.inf) for points in tried if name in points]
        for rate in RATES[optimiser]
        for name in [rate_name(optimiser, rule, rate)]
    }
    if not all(errors.values()):
        return None
    return min(errors, key=lambda rate: sum(errors[rate]) / len(errors[rate]))


def _turn(width: int, seed: int) -> str:
    return f"width {width}, seed {seed}"


def _width_and_seed(turn: str) -> tuple[int, int]:
    words = turn.replace(",", "").split()
    return int(words[1]), int(words[3])


def _course(workshop: Workshop) -> "Course":
    from infra.bench.sides.rated_trainings import course_of

    extent, data = extent_of(workshop.effort), workshop.asked.data or ""
    course = workshop.kept("course", lambda: course_of(data, extent.held_out))
    workshop.note(course.about)
    return course


def _amount(workshop: Workshop) -> "Amount":
    from infra.bench.sides.rated_trainings import Amount

    extent = extent_of(workshop.effort)
    return Amount(
        steps=extent.steps,
        scenes_per_step=extent.scenes_per_step,
        precision=extent.precision,
    )


def _measure_rates(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    from infra.bench.sides.rated_trainings import BASE_WIDTH, Rated, rated

    width, seed = _width_and_seed(turn)
    course, amount = _course(workshop), _amount(workshop)
    for point in points:
        one = Rated(**point.settings)
        if width == BASE_WIDTH:  # rates that follow the width are the same there
            one = dataclasses.replace(one, by_width=False)
        device = workshop.asked.device
        train = functools.partial(rated, course, one, amount, width=width, seed=seed, device=device)
        figures = dict(workshop.kept((turn, one), train))
        if "log_l1" in figures:
            figures[f"w{width}"] = figures["log_l1"]
        yield point.name, figures


def _rate_points(effort: Effort) -> list[Point]:
    return [
        Point(
            name=rate_name(optimiser, rule, rate),
            settings={"optimiser": optimiser, "learning_rate": rate, "by_width": RULES[rule]},
        )
        for rule in extent_of(effort).rules
        for optimiser, rates in RATES.items()
        for rate in rates
    ]


def _rule(point: Point) -> str:
    return BY_WIDTH if point.settings["by_width"] else ONE_RATE


OPTIMISERS: Mapping[str, Mapping[str, object]] = {
    "AdamW": {"optimiser": "AdamW"},
    "Muon": {"optimiser": "Muon"},
    "AdamW, half the steps": {"optimiser": "AdamW", "steps_share": 0.5},
    "Muon, half the steps": {"optimiser": "Muon", "steps_share": 0.5},
}
SCHEDULES: Mapping[str, Mapping[str, object]] = {
    "AdamW": {"optimiser": "AdamW"},
    "Muon": {"optimiser": "Muon"},
    "AdamW, cosine": {"optimiser": "AdamW", "schedule": "cosine"},
    "Muon, cosine": {"optimiser": "Muon", "schedule": "cosine"},
}
RIVAL = "AdamW"


def _measure_compared(workshop: Workshop, points: Sequence[Point], turn: str) -> TurnFigures:
    from infra.bench.sides.rated_trainings import BASE_WIDTH, Rated, rated

    width, seed = _width_and_seed(turn)
    extent, course, amount = extent_of(workshop.effort), _course(workshop), _amount(workshop)
    best = best_rates(extent, workshop.results)
    of_turn: dict[str, dict[str, float]] = {}
    for point in points:
        optimiser = point.settings["optimiser"]
        rate = best[optimiser, width]
        workshop.note(f"{optimiser} at width {width} with a rate of {rate:g}")
        by_width = RULES[extent.rules[0]] and width != BASE_WIDTH
        one = Rated(learning_rate=rate, by_width=by_width, **point.settings)
        figures = rated(course, one, amount, width=width, seed=seed, device=workshop.asked.device)
        of_turn[point.name] = figures
        if point.name.endswith("cosine") and "percent" in figures:
            figures["beside_wsd"] = figures["percent"] - of_turn[optimiser]["percent"]
        yield point.name, figures


def _compared_points(compared: Mapping[str, Mapping[str, object]], effort: Effort) -> list[Point]:
    return [
        Point(name=name, settings=settings, default=name == "Muon")
        for name, settings in compared.items()
    ]


def _compared_turns(effort: Effort) -> list[str]:
    extent = extent_of(effort)
    # with others than those that chose the rates, where these were several
    first = extent.seeds if extent.seeds > 1 else 0
    seeds = range(first, first + extent.compared_seeds)
    return [_turn(width, seed) for seed, width in itertools.product(seeds, extent.compared_widths)]


def _rate_turns(effort: Effort) -> list[str]:
    extent = extent_of(effort)
    return [_turn(width, seed) for seed in range(extent.seeds) for width in extent.widths]


_AT_BEST = (
    "The networks and scenes of `learning-rates`, each optimiser with its best rate of that table "
    "at each width"
)
_TURNS = "A turn is a width and a seed of weights, order and symmetries."


def thousandths(value: float) -> float:
    """Return a number in thousandths, for `Column.then`."""
    return 1000 * value


_COST = Column(name="core-seconds of a training", figure="core_s", over="mean")
_ERROR = Column(name="held-out log L1, thousandths", figure="log_l1", over="mean", then=thousandths)


EXPERIMENTS = (
    Experiment(
        name="learning-rates",
        title="Learning rates by width",
        about=f"Small networks of the view stage `bundles`, {_EXTENTS_SAID}; wsd, one thread. "
        "`one rate`: as in the paper; `by width`: rates and initial weights follow the width from "
        "64 on (`base_widths`). Muon's own rate is three times the stated one.",
        covers=("train.learning_rate", "train.muon_rate", "train.base_widths.width"),
        cost=_COST,
        error=_ERROR,
        against=f"{_AGAINST}; the mean of the widths",
        columns=tuple(
            Column(name=f"width {width}", figure=f"w{width}", over="mean", then=thousandths)
            for width in WIDTHS
        ),
        line_of=lambda point: (
            f"{point.settings['optimiser']}, {_rule(point)}",
            point.settings["learning_rate"],
        ),
        because="A rate transfers where the same row is the best of its kind in every column; rows "
        "that are 2 % apart are equal. `pretrain` has 7e-4, about where parabolas through Muon's "
        "rows have their least error (docs/log/2026-11-26-rates-on-a-card.md).",
        points=_rate_points,
        turns=_rate_turns,
        measure=_measure_rates,
        by_point=True,
        needs=("torch", "data"),
    ),
    Experiment(
        name="optimisers",
        title="Optimisers, each at its best rate",
        about=f"{_AT_BEST}, in all steps or in half. {_TURNS}",
        covers=("train.muon_rate", "train.num_steps"),
        cost=_COST,
        error=_ERROR,
        against=_AGAINST,
        rival=lambda asked: RIVAL,
        columns=(Column(name="more than AdamW, %", figure="percent", over="pair"),),
        because="Differences are of pairs of one width and seed, with bootstrapped 95 % intervals "
        "of their mean, which are too narrow for so few pairs: docs/log has those of Student's t.",
        points=functools.partial(_compared_points, OPTIMISERS),
        turns=_compared_turns,
        measure=_measure_compared,
        needs=("torch", "data"),
    ),
    Experiment(
        name="schedules",
        title="Schedules, at the best rate of each optimiser",
        about=f"{_AT_BEST}; cosine beside wsd in equal steps. {_TURNS}",
        covers=("train.schedule", "train.decay_share"),
        cost=_COST,
        error=_ERROR,
        against=_AGAINST,
        columns=(
            Column(name="more than wsd, %", figure="beside_wsd", over="mean"),
            Column(name="%, low", figure="beside_wsd", over="low"),
            Column(name="%, high", figure="beside_wsd", over="high"),
        ),
        because="A schedule is tried at the peak rate that is best with wsd. Intervals are "
        "bootstrapped over the pairs, and too narrow for so few.",
        points=functools.partial(_compared_points, SCHEDULES),
        turns=_compared_turns,
        measure=_measure_compared,
        needs=("torch", "data"),
    ),
)
