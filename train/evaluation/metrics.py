"""Metrics of a picture, scores and summaries of views with the worst ones, paired comparisons."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.precision import tf32
from model.weights import MAX_LIGHTS
from storage.conventions import log10_radiance, radiance_from_log10
from storage.metrics import (
    mean_interval,
    object_psnr_log_db,
    pepper,
    psnr_linear_db,
    psnr_log_db,
    seam,
)
from storage.records.lights import num_lights
from storage.records.material import ROUGHNESS
from storage.records.sample import Sample, ViewRecord
from storage.registry import Registry
from storage.seeds import rng_for
from train.loss.training_loss import Lpips, ssim, tone_map

VALIDATED = ("log_l1", "psnr_log_db", "psnr_linear_db", "object_psnr_log_db")
"""Metrics of the validations of a run."""

Scores = Mapping[str, float]
"""Score of a picture by metric."""


def summarize_scores(views: Sequence[Scores]) -> dict[str, float]:
    """Return mean log_l1, and median and the worse 5th percentile of each dB value."""
    summary = {"log_l1": float(np.mean([view["log_l1"] for view in views]))}
    for metric in VALIDATED[1:]:
        values = [view[metric] for view in views]
        summary[f"{metric}_median"] = float(np.median(values))
        summary[f"{metric}_p5"] = float(np.percentile(values, 5))
    return summary


def fraction_better(views: Sequence[Scores], baseline: Sequence[Scores]) -> float:
    """Return the fraction of views whose log_l1 is below that of the baseline."""
    pairs = zip(views, baseline, strict=True)
    return float(np.mean([view["log_l1"] < other["log_l1"] for view, other in pairs]))


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
    views: Sequence[Scores], baseline: Sequence[Scores], views_of_scene: Sequence[int]
) -> Lead:
    """Return the lead over a baseline on the same views; each scene counts once."""
    pairs = zip(views, baseline, strict=True)
    of_view = np.array([other["log_l1"] - view["log_l1"] for view, other in pairs])
    of_scene = [part.mean() for part in np.split(of_view, np.cumsum(views_of_scene)[:-1])]
    error = None
    if len(of_scene) > 1:
        error = float(np.std(of_scene, ddof=1) / np.sqrt(len(of_scene)))
    return Lead(log_l1=float(np.mean(of_scene)), error=error)


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgedPicture:
    """A picture and its target, with cached values that several metrics need."""

    radiance_rgb: NDArray
    """[R, R, 3] linear radiance of the picture."""
    target_rgb: NDArray
    """[R, R, 3] linear radiance of the target."""
    hits: NDArray[np.bool_]
    """[R, R] True for pixels that see geometry."""
    lpips: Lpips | None
    """The LPIPS network; None without its weights."""

    @cached_property
    def tone_mapped_13RR(self) -> tuple[Tensor, Tensor]:
        """Picture and target [1, 3, R, R] as clamp(log2(1 + radiance), 0, 1), float64."""
        return _tone_map(self.radiance_rgb), _tone_map(self.target_rgb)


@dataclass(frozen=True, kw_only=True)
class Metric:
    """Definition of one metric."""

    score: Callable[[JudgedPicture], float | None]
    """Computes the score; returns None for n/a, such as without the metric's weights."""
    higher_is_better: bool
    """True if a larger score is better."""
    meaning: str
    """Description for reports: unit, tone map, range and library."""
    decimals: int = 4
    """Number of decimals in reports."""
    floor: Callable[[ViewRecord], float] | None = None
    """Returns the score of the target's measured noise; None scores noise of the measured size that
    is added to the target (`noise_floors`)."""


def _log_l1(picture: JudgedPicture) -> float:
    """Return the training loss, of the finished picture."""
    difference = log10_radiance(picture.radiance_rgb) - log10_radiance(picture.target_rgb)
    return float(np.abs(difference).mean(dtype=np.float64))


def hdr_flip(radiance_rgb: NDArray, target_rgb: NDArray) -> float | None:
    """Return the mean HDR-FLIP (Andersson et al. 2021), or None for a black target."""
    import flip_evaluator  # native code, half a second to import

    if not target_rgb.max() > 0:
        return None
    pictures = [np.ascontiguousarray(p, np.float32) for p in (target_rgb, radiance_rgb)]
    _, mean, _ = flip_evaluator.evaluate(*pictures, "HDR", applyMagma=False)
    return float(mean)


@torch.no_grad()
def _lpips(picture: JudgedPicture) -> float | None:
    """Return LPIPS on the device of its weights, in full float32, as published."""
    if picture.lpips is None:
        return None
    device = picture.lpips.shift_311.device
    with tf32(False):
        ours, target = (mapped.float().to(device) for mapped in picture.tone_mapped_13RR)
        return float(picture.lpips(ours, target))


def _tone_map(radiance_rgb: NDArray) -> Tensor:
    log10 = torch.from_numpy(np.ascontiguousarray(log10_radiance(radiance_rgb), np.float64))
    return tone_map(log10).movedim(-1, 0)[None]


def noise_rms(view: ViewRecord) -> float:
    """Return the root mean square of a target's noise, in log10(1 + radiance)."""
    return float(10 ** (-view.noise_floor_db / 20))


METRICS: Registry[Metric] = Registry(
    "metric",
    Metric,
    {
        "psnr_log_db": Metric(
            score=lambda picture: psnr_log_db(picture.radiance_rgb, picture.target_rgb),
            higher_is_better=True,
            meaning="PSNR of log10(1 + radiance), peak 1, nothing clamped (storage.metrics)",
            decimals=2,
            floor=lambda view: view.noise_floor_db,
        ),
        "object_psnr_log_db": Metric(
            score=lambda picture: object_psnr_log_db(
                picture.radiance_rgb, picture.target_rgb, picture.hits
            ),
            higher_is_better=True,
            meaning="the same over pixels whose ray meets geometry",
            decimals=2,
            floor=lambda view: view.object_noise_floor_db,
        ),
        "psnr_linear_db": Metric(
            score=lambda picture: psnr_linear_db(picture.radiance_rgb, picture.target_rgb),
            higher_is_better=True,
            meaning="PSNR of radiance clamped to [0, 1], peak 1; for published figures only",
            decimals=2,
            floor=lambda view: view.noise_floor_linear_db,
        ),
        "ssim": Metric(
            score=lambda picture: float(ssim(*picture.tone_mapped_13RR)),
            higher_is_better=True,
            meaning="SSIM of clamp(log2(1 + radiance), 0, 1), Gaussian windows of 11 pixels "
            "(Wang 2004)",
        ),
        "lpips": Metric(
            score=_lpips,
            higher_is_better=False,
            meaning="LPIPS 0.1 on VGG16 of the same tone map, with the published weights",
        ),
        "hdr_flip": Metric(
            score=lambda picture: hdr_flip(picture.radiance_rgb, picture.target_rgb),
            higher_is_better=False,
            meaning="mean HDR-FLIP of radiance (flip-evaluator, 67 pixels per degree, ACES)",
        ),
        "log_l1": Metric(
            score=_log_l1,
            higher_is_better=False,
            meaning="mean absolute error of log10(1 + radiance), after the output's ELU",
            floor=noise_rms,
        ),
        "pepper": Metric(
            score=lambda picture: pepper(picture.radiance_rgb, picture.target_rgb),
            higher_is_better=False,
            meaning="excess of the standard deviation of log10(1 + radiance) over 3 x 3 pixels",
        ),
        "seam": Metric(
            score=lambda picture: seam(picture.radiance_rgb, picture.target_rgb),
            higher_is_better=False,
            meaning="steps of the error where 16 x 16 tiles meet, over those elsewhere; 1 is none",
        ),
    },
)
"""All metrics, in the order of reports."""


def picture_scores(
    radiance_rgb: NDArray,
    target_rgb: NDArray,
    hits: NDArray[np.bool_],
    lpips: Lpips | None,
    metrics: Iterable[str] = METRICS,
) -> dict[str, float | None]:
    """Return metrics, by default all, of a picture [R, R, 3] of linear radiance; None is n/a.

    LPIPS is n/a without its weights, HDR-FLIP for a black target, which defines its exposures.
    """
    picture = JudgedPicture(
        radiance_rgb=radiance_rgb, target_rgb=target_rgb, hits=hits, lpips=lpips
    )
    return {name: METRICS[name].score(picture) for name in metrics}


def noise_floors(
    sample: Sample,
    view: int,
    target_rgb: NDArray,
    hits: NDArray[np.bool_],
    lpips: Lpips | None,
) -> dict[str, float]:
    """Return the score of the target's noise by metric: no picture can be expected to be better.

    LPIPS has no floor without its weights. The stored floors were measured at the stored
    resolution; larger pixels have less noise, so that at a lower resolution these floors are
    slightly too lenient. For metrics without a measured floor, noise of the stored size is added to
    the target and scored. A denoiser leaves smoother noise than this independent one: these floors
    are a model.

    For log_l1 it is an upper bound, since a mean absolute error is at most the root mean square.

    Args:
        target_rgb: [R, R, 3] linear radiance at the resolution of the evaluation.
        hits: [R, R] True for pixels that see geometry.
    """
    rng = rng_for(0, f"noise of {sample.key}", view)
    stored = sample.views[view]
    noisy = log10_radiance(target_rgb) + rng.normal(0, noise_rms(stored), target_rgb.shape)
    twin = JudgedPicture(
        radiance_rgb=radiance_from_log10(np.maximum(noisy, 0)),
        target_rgb=target_rgb,
        hits=hits,
        lpips=lpips,
    )
    floors = {
        name: metric.floor(stored) if metric.floor else metric.score(twin)
        for name, metric in METRICS.items()
    }
    return {name: floor for name, floor in floors.items() if floor is not None}


NETWORK = "network"
"""Name of the evaluated network among all methods; others are train.evaluation.validation."""

GROUPED = f"network, {MAX_LIGHTS} lights at a time"
"""Name of the same network with lights rendered in groups, to compare groups with one pass. Only
scenes with more lights, or with lights inside objects, have this method."""


@dataclass(frozen=True, kw_only=True)
class JudgedView:
    """Scores of one view of a stored sample."""

    key: str
    """Key of the sample in its shard."""
    view: int
    """Index of the camera, from 0."""
    template: str
    """Name of the scene's layout, or `unknown`."""
    num_triangles: int
    num_lights: int
    roughness: float
    """Roughness of the scene's smoothest surface, emitters excluded."""
    excursion: tuple[str, float] | None
    """Axis and value of a scene outside the usual range; None within it."""
    floors: dict[str, float]
    """Score of the target's noise by metric (metrics.noise_floors)."""
    scores: dict[str, dict[str, float | None]]
    """Score by method and metric; None is n/a. Not every view has every method."""
    swapped_psnr_log_db: float | None = None
    """Score of the network given the previous scene's triangles; None for the first scene."""

    def gap(self, metric: str, contestant: str = NETWORK) -> float | None:
        """Return how much worse a score is than the target's noise; below 0 it is better."""
        score = self.scores[contestant][metric]
        floor = self.floors.get(metric)
        if score is None or floor is None:
            return None
        return floor - score if METRICS[metric].higher_is_better else score - floor


def scene_facts(sample: Sample) -> dict[str, Any]:
    """Return the facts about a sample's scene, as fields of JudgedView."""
    scene = sample.scene
    reflecting = np.unique(scene.material_index[~scene.triangle_emits])
    excursion = scene.provenance.get("excursion")
    return {
        "key": sample.key,
        "template": str(scene.provenance.get("template", "unknown")),
        "num_triangles": scene.num_triangles,
        "num_lights": num_lights(scene),
        "roughness": float(scene.materials[reflecting, ROUGHNESS].min(initial=1.0)),
        "excursion": (
            (str(excursion["axis"]), float(excursion["value"])) if excursion is not None else None
        ),
    }


NEAR_DB = 3.0
"""Maximum distance in dB of psnr_log_db from its floor that counts as `near_floor`."""

TRIANGLES = (256, 512, 1024, 1536, 4096)
LIGHTS = (1, 2, 4, 8)
ROUGHNESSES = (0.1, 0.25, 0.5)
"""Upper ends of the roughness groups; one more group holds larger values."""

SPLITS: Mapping[str, Callable[[JudgedView], str]] = {
    "template": lambda view: view.template,
    "triangles": lambda view: _part(view.num_triangles, TRIANGLES),
    "lights": lambda view: _part(view.num_lights, LIGHTS),
    "smoothest roughness": lambda view: _part(view.roughness, ROUGHNESSES),
}
"""Groupings of views by name: each returns the group of a view."""


def by_group(views: Sequence[JudgedView]) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the network's summary by grouping and group, in the order of the groups."""
    return {
        name: {
            part: summarize_views([view for view in views if part_of(view) == part])
            for part in sorted(set(map(part_of, views)), key=_order)
        }
        for name, part_of in SPLITS.items()
    }


def summarize_views(views: Sequence[JudgedView], contestant: str = NETWORK) -> dict[str, Any]:
    """Return median, mean and worse 5th percentile of every metric, and the gap to the noise.

    A metric that is n/a for any view is None: a mean over the other views would be of another set.
    `near_floor` is the fraction of views within NEAR_DB of their floor.
    """
    result: dict[str, Any] = {"views": len(views)}
    for name, metric in METRICS.items():
        values = [view.scores[contestant][name] for view in views]
        known = [value for value in values if value is not None]
        gaps = [gap for view in views if (gap := view.gap(name, contestant)) is not None]
        is_complete = len(known) == len(values)
        worse = 5 if metric.higher_is_better else 95
        result[name] = {
            "median": float(np.median(known)) if is_complete else None,
            "mean": float(np.mean(known)) if is_complete else None,
            "worse_5_percent": float(np.percentile(known, worse)) if is_complete else None,
            "median_worse_than_noise": float(np.median(gaps)) if gaps else None,
        }
    log_gaps = [view.gap("psnr_log_db", contestant) for view in views]
    result["near_floor"] = float(np.mean([gap is not None and gap <= NEAR_DB for gap in log_gaps]))
    return result


def _part(value: float, ends: Sequence[float]) -> str:
    for start, end in zip((None, *ends), ends, strict=False):
        if value <= end:
            return f"up to {end:g}" if start is None else f"over {start:g}, up to {end:g}"
    return f"over {ends[-1]:g}"


def _order(part: str) -> tuple[float, str]:
    """Return the sort key of a group: ranges by their start, names alphabetically."""
    word, _, rest = part.partition(" ")
    return (float(rest.split(",")[0]), part) if word == "over" else (-1.0, part)


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
