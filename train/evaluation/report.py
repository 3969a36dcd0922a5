"""Report of an evaluation as JSON values."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from train.evaluation.judged_view import (
    GROUPED,
    NETWORK,
    JudgedView,
    by_group,
    summarize_views,
)
from train.evaluation.metrics import METRICS
from train.evaluation.published import BENCHMARK, PUBLISHED


def record(
    views: Sequence[JudgedView],
    about: Mapping[str, Any],
    traced: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return all measurements of an evaluation as JSON values.

    Args:
        views: rows of the evaluation.
        about: network, data, split and resolution, as the report shows them.
        traced: comparison at equal time (evaluation.equal_time); None if it was not measured.
    """
    ours = summarize_views(views)
    published = {
        metric: {"published": figure, "ours": ours[metric]["mean"]}
        for metric, figure in PUBLISHED.items()
    }
    return {
        "about": dict(about),
        "metrics": {name: metric.meaning for name, metric in METRICS.items()},
        "contestants": {
            name: summarize_views(views, name)
            for name in views[0].scores
            if all(name in view.scores for view in views)
        },
        "path tracer": traced,
        "swapped scenes": loss_by_swapping(views),
        "light passes": passes_compared(views),
        "published": published if about.get("build") == BENCHMARK else None,
        "groups": by_group(views),
        "views": [dataclasses.asdict(view) for view in views],
    }


def passes_compared(views: Sequence[JudgedView]) -> dict[str, Any] | None:
    """Return summaries of one pass and of light groups over the views that have both, or None."""
    both = [view for view in views if GROUPED in view.scores]
    if not both:
        return None
    return {"one pass": summarize_views(both, NETWORK), "groups": summarize_views(both, GROUPED)}


def loss_by_swapping(views: Sequence[JudgedView]) -> dict[str, Any] | None:
    """Return the loss of psnr_log_db with another scene's triangles; None for a single scene."""
    losses_db = [
        own_db - view.swapped_psnr_log_db
        for view in views
        if view.swapped_psnr_log_db is not None
        and (own_db := view.scores[NETWORK]["psnr_log_db"]) is not None
    ]
    if not losses_db:
        return None
    return {
        "views": len(losses_db),
        "median_db": float(np.median(losses_db)),
        "mean_db": float(np.mean(losses_db)),
        "share_lost": float(np.mean(np.array(losses_db) > 0)),
    }
