"""Two contestants view by view: what one has more than the other, and how sure that is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from storage.intervals import mean_interval
from train.evaluation.judged_view import JudgedView

METRIC = "psnr_log_db"
"""What pairs are compared by."""


@dataclass(frozen=True, kw_only=True)
class PairedLead:
    """The difference of METRIC over the views that have both."""

    mean: float
    """Mean of the differences, in dB; above 0 the first one is better."""
    low: float | None
    """Lower end of its 95 % interval, bootstrapped over whole scenes; None of a single scene, which
    says nothing of others."""
    high: float | None
    """Upper end."""
    share_better: float
    """Share of the views in which the first one is better."""


def pair(views: Sequence[JudgedView], first: str, second: str) -> PairedLead:
    """Return what the contestant `first` has more than `second`, on views that have both."""
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
