"""What the rows say of each contestant: medians, tails, price, and pairs with one of them."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from infra.cost_tables import on_front
from infra.leaderboard.contest import NOISE, JudgedWidth
from train.evaluation.judged_view import summary
from train.evaluation.pairs import METRIC, PairedLead, pair


@dataclass(frozen=True, kw_only=True)
class Standing:
    """One contestant at one width."""

    name: str
    """Its name."""
    kind: str
    """What it is one of; empty for NOISE."""
    first_s: float | None
    """Median core-seconds of a scene's first view; None where nothing was timed."""
    further_s: float | None
    """Median core-seconds of a further view."""
    timed_scenes: int
    """Scenes that these are medians of."""
    scores: Mapping[str, Any]
    """As train.evaluation.judged_view.summary."""
    lead: PairedLead | None
    """What it has more than the rival; None for the rival itself and for NOISE."""
    on_front: bool | None
    """Whether no other one is as good at its price; None where the price is not known."""

    @property
    def median_db(self) -> float:
        """Median of METRIC, by which the table is sorted."""
        return float(self.scores[METRIC]["median"])


@dataclass(frozen=True, kw_only=True)
class WidthStandings:
    """The table of one width."""

    width: int
    """Pixels across."""
    num_scenes: int
    """Scenes that everybody showed."""
    num_views: int
    """Views of them."""
    standings: tuple[Standing, ...]
    """The best one first; NOISE before all others."""
    pairs: Mapping[tuple[str, str], PairedLead]
    """What the first one has more than the second, of every two."""


def standings_of(judged: JudgedWidth, kinds: Mapping[str, str], rival: str) -> WidthStandings:
    """Return the table of a width.

    Args:
        judged: with one view at least.
        kinds: of each contestant, by its name.
        rival: name of the one that all others are compared with.
    """
    names = [name for name in judged.views[0].scores if name != NOISE]
    pairs = {two: pair(judged.views, *two) for two in itertools.permutations(names, 2)}
    front = _front(judged, names)
    standings = [
        Standing(
            name=name,
            kind=kinds.get(name, ""),
            first_s=_median(judged.first_s.get(name)),
            further_s=_median(judged.further_s.get(name)),
            timed_scenes=len(judged.first_s.get(name, ())),
            scores=summary(judged.views, name),
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
        median_db = float(summary(judged.views, name)[METRIC]["median"])
        costs = [float(np.median(each[name])) for each in (judged.first_s, judged.further_s)]
        figures.append((-median_db, costs))
    return dict(zip(priced, on_front(figures), strict=True))


def _median(seconds: Sequence[float] | None) -> float | None:
    return float(np.median(seconds)) if seconds else None
