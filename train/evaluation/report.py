"""Report of an evaluation as JSON values, and the scores of the RenderFormer paper beside it."""

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

BENCHMARK = "benchmark-v1"
"""Name of our public test set (pipeline.presets.judging)."""

_METRICS = ("psnr_linear_db", "ssim", "lpips", "hdr_flip")

_SHOWN = {
    "RenderFormer, 12 + 6 layers, 205 M (the paper's)": (29.77, 0.9526, 0.0551, 0.1751),
    "9 + 9 layers": (30.11, 0.9554, 0.0512, 0.1735),
    "6 + 12 layers": (30.38, 0.9560, 0.0504, 0.1685),
    "view stage in world space": (28.98, 0.9420, 0.0631, 0.1904),
    "without DPT": (29.75, 0.9476, 0.0552, 0.1806),
    "without self-attention of rays": (29.70, 0.9503, 0.0570, 0.1766),
    "without either": (29.15, 0.9396, 0.0641, 0.1836),
}

PUBLISHED_ROWS: Mapping[str, Mapping[str, float]] = {
    name: dict(zip(_METRICS, figures, strict=True)) for name, figures in _SHOWN.items()
}
"""Zeng et al. 2025, Table 1: means over 400 scenes of four views each, 256 x 256."""

PUBLISHED = next(iter(PUBLISHED_ROWS.values()))
"""Scores of the network whose weights were published."""

PUBLISHED_WHERE = (
    "The paper's figures (Zeng et al. 2025, Table 1) are of 400 scenes of its own with four views "
    "each at 256 x 256, which were never released, and it does not say how it tone-mapped: same "
    "kind of set, not the same set."
)


def record(
    views: Sequence[JudgedView],
    about: Mapping[str, Any],
    traced: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return all measurements of an evaluation as JSON values.

    Args:
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
