"""Table of each width from the rows: medians, tails, costs, and paired differences."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from train.evaluation.board import NOISE, JudgedWidth
from train.evaluation.cost_tables import on_front
from train.evaluation.judged_view import summarize_views
from train.evaluation.pairs import METRIC, PairedLead, paired_lead
from train.evaluation.timing import median_price


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Figures of one method at one width."""

    name: str
    """Name of the method, or NOISE."""
    kind: str
    """Kind of method; empty for NOISE."""
    first_s: float | None
    """Median CPU seconds of a scene's first view; None without times."""
    further_s: float | None
    """Median CPU seconds of a further view; None without times."""
    timed_scenes: int
    """Number of scenes behind these medians."""
    scores: Mapping[str, Any]
    """Summary of each metric by name (train.evaluation.judged_view.summarize_views)."""
    lead: PairedLead | None
    """Paired difference from the rival; None for the rival and for NOISE."""
    on_front: bool | None
    """True on the Pareto front of error and costs; None without costs."""

    @property
    def median_db(self) -> float:
        """Median of METRIC over the views, by which the table is sorted."""
        return float(self.scores[METRIC]["median"])


@dataclass(frozen=True, kw_only=True)
class WidthStandings:
    """Table of one width."""

    width: int
    """Width of the pictures in pixels."""
    num_scenes: int
    """Number of scenes that all methods rendered."""
    num_views: int
    """Number of views of these scenes."""
    standings: tuple[Standing, ...]
    """Rows, NOISE first, then sorted from the best to the worst."""
    pairs: Mapping[tuple[str, str], PairedLead]
    """Paired difference of the first from the second, for every pair of names."""


def standings_of(judged: JudgedWidth, kinds: Mapping[str, str], rival: str) -> WidthStandings:
    """Return the table of a width.

    Args:
        judged: scores and times, with one view at least.
        kinds: kind of each method by name.
        rival: name of the row that all others are compared with.
    """
    names = [name for name in judged.views[0].scores if name != NOISE]
    pairs = {two: paired_lead(judged.views, *two) for two in itertools.permutations(names, 2)}
    scores = {name: summarize_views(judged.views, name) for name in [NOISE, *names]}
    costs = {name: median_price(prices) for name, prices in judged.prices.items()}
    figures = [
        (-float(scores[name][METRIC]["median"]), (cost.first_s, cost.further_s))
        for name, cost in costs.items()
    ]
    front = dict(zip(costs, on_front(figures), strict=True))
    standings = [
        Standing(
            name=name,
            kind=kinds.get(name, ""),
            first_s=costs[name].first_s if name in costs else None,
            further_s=costs[name].further_s if name in costs else None,
            timed_scenes=len(judged.prices.get(name, ())),
            scores=scores[name],
            lead=pairs.get((name, rival)),
            on_front=front.get(name),
        )
        for name in scores
    ]
    return WidthStandings(
        width=judged.width,
        num_scenes=len({view.key for view in judged.views}),
        num_views=len(judged.views),
        standings=tuple(sorted(standings, key=lambda one: (one.name != NOISE, -one.median_db))),
        pairs=pairs,
    )
