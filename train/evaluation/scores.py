"""Scores of single views, and summaries that include the worst views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.conventions import log10_radiance
from storage.metrics import object_psnr_log_db, psnr_linear_db, psnr_log_db


@dataclass(frozen=True, kw_only=True)
class ViewScore:
    """Scores of one picture against its target; storage.metrics defines those in dB."""

    log_l1: float
    """Mean |log10(1 + a) - log10(1 + b)|: the training loss, of the finished picture."""
    psnr_log_db: float
    psnr_linear_db: float
    object_psnr_log_db: float


def score_view(radiance_rgb: NDArray, target_rgb: NDArray, hits: NDArray[np.bool_]) -> ViewScore:
    """Score one picture [R, R, 3] of linear radiance; `hits` is [R, R] (judge.hit_masks)."""
    difference = log10_radiance(radiance_rgb) - log10_radiance(target_rgb)
    return ViewScore(
        log_l1=float(np.abs(difference).mean(dtype=np.float64)),
        psnr_log_db=psnr_log_db(radiance_rgb, target_rgb),
        psnr_linear_db=psnr_linear_db(radiance_rgb, target_rgb),
        object_psnr_log_db=object_psnr_log_db(radiance_rgb, target_rgb, hits),
    )


def summarize_scores(views: Sequence[ViewScore]) -> dict[str, float]:
    """Return mean log_l1, and median and the worse 5th percentile of each dB value."""
    summary = {"log_l1": float(np.mean([view.log_l1 for view in views]))}
    for metric in ("psnr_log_db", "psnr_linear_db", "object_psnr_log_db"):
        values = [getattr(view, metric) for view in views]
        summary[f"{metric}_median"] = float(np.median(values))
        summary[f"{metric}_p5"] = float(np.percentile(values, 5))
    return summary


def fraction_better(views: Sequence[ViewScore], baseline: Sequence[ViewScore]) -> float:
    """Return the fraction of views whose log_l1 is below that of the baseline."""
    pairs = zip(views, baseline, strict=True)
    return float(np.mean([view.log_l1 < other.log_l1 for view, other in pairs]))


@dataclass(frozen=True, kw_only=True)
class Lead:
    """Mean advantage of a network over a baseline, with its standard error."""

    log_l1: float
    """Mean decrease of log_l1, over scenes."""
    error: float | None
    """Standard error of that mean over scenes; None for a single scene."""

    @property
    def is_sure(self) -> bool:
        """True if the mean is larger than two standard errors."""
        return self.error is not None and self.log_l1 > 2 * self.error


def lead(
    views: Sequence[ViewScore], baseline: Sequence[ViewScore], views_of_scene: Sequence[int]
) -> Lead:
    """Return the lead over a baseline on the same views; each scene counts once."""
    pairs = zip(views, baseline, strict=True)
    of_view = np.array([other.log_l1 - view.log_l1 for view, other in pairs])
    of_scene = [part.mean() for part in np.split(of_view, np.cumsum(views_of_scene)[:-1])]
    error = None
    if len(of_scene) > 1:
        error = float(np.std(of_scene, ddof=1) / np.sqrt(len(of_scene)))
    return Lead(log_l1=float(np.mean(of_scene)), error=error)
