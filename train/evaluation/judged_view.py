"""One view of a dataset, what is known of it, and how each contestant did."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from storage.records.lights import num_lights
from storage.records.material import ROUGHNESS
from storage.records.sample import Sample
from train.evaluation.metrics import METRICS

NETWORK = "network"
"""Name of the contestant that is judged; the others are train.evaluation.rivals."""


@dataclass(frozen=True, kw_only=True)
class JudgedView:
    """A row of the evaluation."""

    key: str
    """Key of the sample."""
    view: int
    """Which of its cameras."""
    template: str
    """Layout of the scene."""
    num_triangles: int
    """Of the scene."""
    num_lights: int
    """Of the scene."""
    roughness: float
    """Of its smoothest surface, emitters apart."""
    excursion: tuple[str, float] | None
    """Axis and value by which the scene leaves the usual range, if it does."""
    floors: dict[str, float]
    """What the target's noise alone would score (evaluation.noise_floors)."""
    scores: dict[str, dict[str, float | None]]
    """By contestant and metric; None is n/a. Not every view has every contestant."""
    swapped_psnr_log_db: float | None = None
    """Of the network shown the triangles of the scene before; None for the first scene."""

    def gap(self, metric: str, contestant: str = NETWORK) -> float | None:
        """Return how much worse the picture is than the noise of its target; below 0: not worse."""
        score, floor = self.scores[contestant][metric], self.floors.get(metric)
        if score is None or floor is None:
            return None
        return floor - score if METRICS[metric].higher_is_better else score - floor


def facts_of(sample: Sample) -> dict[str, Any]:
    """Return what is known of a sample's scene, by the names of JudgedView."""
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
