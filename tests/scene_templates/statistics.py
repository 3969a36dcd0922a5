"""Is a sample what the settings say it is? p-values, and one line between chance and a defect.

Every quantity that is drawn gets a p-value against its stated distribution: Kolmogorov-Smirnov for
numbers, chi-square for choices, the exact binomial test for shares. A table of such p-values is
plausible if none falls below LEVEL.
"""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar
from unittest import mock

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from scene_templates.recorded_sampler import RecordedDraw, RecordedSampler

FALSE_ALARM = 1e-6
"""Probability that any p-value of the whole suite falls below LEVEL although all is as stated."""

MOST_TABLES, MOST_ROWS = 20, 250
"""Tables that the tests make, and p-values in each, at most: `implausible` counts the rows."""

LEVEL = FALSE_ALARM / (MOST_TABLES * MOST_ROWS)
"""By Bonferroni's inequality, which holds however the p-values depend on each other. With 2000
numbers a KS distance of 0.08 is found, with 500 one of 0.15."""

Table = Mapping[str, float]
"""p-values by what they are about."""

Choice = TypeVar("Choice", bound=Hashable)


def uniform(values: ArrayLike, low: float, high: float) -> float:
    """Return the p-value of numbers uniform in [low, high]; where these are equal, 1 or 0."""
    numbers = np.asarray(values, np.float64)
    if low == high:
        return float((numbers == low).all())
    return by_cdf((numbers - low) / (high - low), lambda share: np.clip(share, 0, 1))


def by_cdf(values: ArrayLike, cdf: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the p-value of numbers with a continuous distribution function."""
    numbers = np.asarray(values, np.float64)
    assert len(numbers) >= 30, "too few to tell anything"
    return float(stats.kstest(numbers, cdf).pvalue)


def alike(values: ArrayLike, twin: ArrayLike) -> float:
    """Return the p-value of numbers that come from where those of a slow twin come from."""
    one, other = np.asarray(values, np.float64), np.asarray(twin, np.float64)
    assert min(len(one), len(other)) >= 30, "too few to tell anything"
    return float(stats.ks_2samp(one, other).pvalue)


def choices(found: Sequence[Choice], expected: Mapping[Choice, float]) -> float:
    """Return the p-value of a choice with given odds; 0 where something else was chosen.

    Choices expected less than five times would make chi-square unreliable, and are refused.
    """
    if set(found) - set(expected):
        return 0.0
    odds = np.array(list(expected.values()), np.float64)
    wanted = odds / odds.sum() * len(found)
    assert wanted.min() >= 5, "too few to tell anything"
    counts = [list(found).count(kind) for kind in expected]
    return float(stats.chisquare(counts, wanted).pvalue) if len(counts) > 1 else 1.0


def share(found: Sequence[bool] | ArrayLike, expected: float) -> float:
    """Return the p-value of independent tosses that succeed with a given probability."""
    tosses = np.asarray(found, bool)
    assert len(tosses) >= 30, "too few to tell anything"
    return float(stats.binomtest(int(tosses.sum()), len(tosses), expected).pvalue)


def implausible(table: Table) -> dict[str, float]:
    """Return the rows that are no chance."""
    assert 0 < len(table) <= MOST_ROWS
    return {name: p for name, p in table.items() if not p >= LEVEL}


def require_plausible(table: Table) -> None:
    """Assert that nothing in a table is implausible."""
    assert not implausible(table)


def merged(many: Iterable[Mapping[str, RecordedDraw]]) -> dict[str, RecordedDraw]:
    """Return the draws of many surfaces or skies as if one had made them all."""
    found: dict[str, RecordedDraw] = {}
    for made in many:
        for name, draw in made.items():
            whole = found.setdefault(name, RecordedDraw(kind=draw.kind, stated=draw.stated))
            assert (whole.kind, whole.stated) == (draw.kind, draw.stated), name
            whole.values.extend(draw.values)
    return found


def stated_table(made: Mapping[str, RecordedDraw]) -> Table:
    """Return a p-value for each number that was drawn, of names with at least 60 values."""
    table: dict[str, float] = {}
    for name, draw in made.items():
        if len(draw.values) >= 60:
            table |= _rows(name, draw.kind, draw.stated, draw.values)
    return table


def _rows(name: str, kind: str, stated: Any, values: list[Any]) -> Table:
    if kind == "share":
        return {name: share(values, stated)}
    if kind == "choice":
        return {name: choices(values, dict.fromkeys(stated, 1.0))}
    low, high = stated
    if kind == "whole number":
        return {name: choices(values, dict.fromkeys(range(low, high + 1), 1.0))}
    if kind == "shade":
        return {name: uniform(values, 0, 1)}
    if kind == "colour":
        columns = np.array(values).T
        return {
            f"{name} {channel}": uniform(column, *ends)
            for channel, column, *ends in zip("rgb", columns, low, high, strict=True)
        }
    if kind == "direction":
        x, y, z = np.array(values).T
        ends = np.sin(np.radians(stated))
        return {
            f"{name} height": uniform(z, *ends),
            f"{name} azimuth": uniform(np.arctan2(y, x), -np.pi, np.pi),
        }
    return {name: uniform(values, low, high)}


Made = TypeVar("Made")
Args = ParamSpec("Args")


def with_draws(
    draw: Callable[Args, Made], *args: Args.args, **options: Args.kwargs
) -> tuple[Made, Mapping[str, tuple[Any, ...]]]:
    """Return what a function makes, and the values that it drew, by name."""
    samplers: list[RecordedSampler] = []
    begin = RecordedSampler.__init__

    def noted(self: RecordedSampler, rng: np.random.Generator) -> None:
        begin(self, rng)
        samplers.append(self)

    with mock.patch.object(RecordedSampler, "__init__", noted):
        made = draw(*args, **options)
    return made, drawn_values(samplers[-1])


def drawn_values(sampler: RecordedSampler) -> Mapping[str, tuple[Any, ...]]:
    """Return what was drawn so far by its names: numbers, words, truth values and lists."""
    return {
        name: tuple(v.tolist() if isinstance(v, np.ndarray) else v for v in draw.values)
        for name, draw in sampler.made.items()
    }
