"""Table of each width from the rows: medians, tails, costs, and paired differences."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from train.evaluation.board import NOISE, Board
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
    num_views: int
    """Number of views that all methods rendered."""
    triangles: Mapping[str, int]
    """Number of triangles of each scene by its key."""
    standings: tuple[Standing, ...]
    """Rows, NOISE first, then sorted from the best to the worst."""
    pairs: Mapping[tuple[str, str], PairedLead]
    """Paired difference of the first from the second, for every pair of names."""

    @property
    def num_scenes(self) -> int:
        """Number of scenes of these views."""
        return len(self.triangles)


def standings_of(board: Board, width: int, rival: str) -> WidthStandings | None:
    """Return the table of a width, compared with `rival`; None without a judged view."""
    views = list(board.views(width))
    if not views:
        return None
    names = [name for name in views[0].scores if name != NOISE]
    pairs = {two: paired_lead(views, *two) for two in itertools.permutations(names, 2)}
    scores = {name: summarize_views(views, name) for name in [NOISE, *names]}
    prices = board.prices(width)
    costs = {name: median_price(each) for name, each in prices.items()}
    figures = [
        (-float(scores[name][METRIC]["median"]), (cost.first_s, cost.further_s))
        for name, cost in costs.items()
    ]
    front = dict(zip(costs, on_front(figures), strict=True))
    standings = [
        Standing(
            name=name,
            kind=board.kinds.get(name, ""),
            first_s=costs[name].first_s if name in costs else None,
            further_s=costs[name].further_s if name in costs else None,
            timed_scenes=len(prices.get(name, ())),
            scores=summary,
            lead=pairs.get((name, rival)),
            on_front=front.get(name),
        )
        for name, summary in scores.items()
    ]
    return WidthStandings(
        width=width,
        num_views=len(views),
        triangles={view.key: view.num_triangles for view in views},
        standings=tuple(sorted(standings, key=lambda one: (one.name != NOISE, -one.median_db))),
        pairs=pairs,
    )
