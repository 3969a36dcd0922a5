"""Table of each width from the rows: medians, tails, costs, and paired differences."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from infra.cost_tables import on_front
from infra.leaderboard.contest import NOISE, JudgedWidth
from train.evaluation.judged_view import summarize_views
from train.evaluation.pairs import METRIC, PairedLead, paired_lead


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Figures of one contestant at one width."""

    name: str
    """Name of the contestant, or NOISE."""
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
    """Number of scenes that all contestants rendered."""
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
        kinds: kind of each contestant by name.
        rival: name of the row that all others are compared with.
    """
    names = [name for name in judged.views[0].scores if name != NOISE]
    pairs = {two: paired_lead(judged.views, *two) for two in itertools.permutations(names, 2)}
    front = _front(judged, names)
    standings = [
        Standing(
            name=name,
            kind=kinds.get(name, ""),
            first_s=_median(judged.first_s.get(name)),
            further_s=_median(judged.further_s.get(name)),
            timed_scenes=len(judged.first_s.get(name, ())),
            scores=summarize_views(judged.views, name),
            lead=pairs.get((name, rival)),
            on_front=front.get(name),
        )
        for name in [NOISE, *names]
    ]
    order = sorted(standings, key=lambda one: (one.name != NOISE, -one.median_db))
    return WidthStandings(
        width=judged.width,
        num_scenes=len({view.key for view in judged.views}),
        num_views=len(judged.views),
        standings=tuple(order),
        pairs=pairs,
    )


def _front(judged: JudgedWidth, names: Sequence[str]) -> dict[str, bool]:
    priced = [name for name in names if judged.first_s.get(name)]
    figures = []
    for name in priced:
        median_db = float(summarize_views(judged.views, name)[METRIC]["median"])
        costs = [float(np.median(each[name])) for each in (judged.first_s, judged.further_s)]
        figures.append((-median_db, costs))
    return dict(zip(priced, on_front(figures), strict=True))


def _median(seconds: Sequence[float] | None) -> float | None:
    return float(np.median(seconds)) if seconds else None
