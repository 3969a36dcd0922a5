"""Rows of an evaluation, one per view, their summaries by groups, and paired comparisons."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.weights import MAX_LIGHTS
from storage.metrics import mean_interval
from storage.records.lights import num_lights
from storage.records.material import ROUGHNESS
from storage.records.sample import Sample
from train.evaluation.metrics import METRICS

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
    groups: dict[str, dict[str, dict[str, Any]]] = {}
    for name, part_of in SPLITS.items():
        parts: dict[str, list[JudgedView]] = {}
        for view in views:
            parts.setdefault(part_of(view), []).append(view)
        ordered = sorted(parts.items(), key=lambda part: _order(part[0]))
        groups[name] = {part: summarize_views(members) for part, members in ordered}
    return groups


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
