"""Paired comparison of two methods over the same views, with a confidence interval."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from storage.intervals import mean_interval
from train.evaluation.judged_view import JudgedView

METRIC = "psnr_log_db"
"""Metric of paired comparisons, in dB."""


@dataclass(frozen=True, kw_only=True)
class PairedLead:
    """Difference of METRIC between two methods over the same views."""

    mean: float
    """Mean of the differences, in dB; above 0 the first one is better."""
    low: float | None
    """Lower end of the 95 % interval, bootstrapped over whole scenes; None for a single scene."""
    high: float | None
    """Upper end of the same interval; None for a single scene."""
    share_better: float
    """Fraction of the views in which the first method is better."""


def paired_lead(views: Sequence[JudgedView], first: str, second: str) -> PairedLead:
    """Return the lead of method `first` over `second`, on views that have both."""
    leads_db = [
        (view.scores[first][METRIC] or 0.0) - (view.scores[second][METRIC] or 0.0) for view in views
    ]
    scenes = [view.key for view in views]
    interval = mean_interval(leads_db, scenes) if len(set(scenes)) > 1 else None
    return PairedLead(
        mean=float(np.mean(leads_db)),
        low=interval and interval[0],
        high=interval and interval[1],
        share_better=float(np.mean(np.array(leads_db) > 0)),
    )


def interval_text(low: float | None, high: float | None, decimals: int = 2) -> str:
    """Return the ends of an interval as text; empty if there is no interval."""
    if low is None or high is None:
        return ""
    return f"{low:+.{decimals}f} to {high:+.{decimals}f}"
