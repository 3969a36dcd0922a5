"""Validation of a network against the targets and the median picture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from model.renderformer import RenderFormer, radiance
from storage.conventions import radiance_from_log10
from storage.raycast.first_hits import first_hits
from storage.records.sample import Sample
from storage.records.scene import Scene
from train.data.buckets import collate_batch
from train.data.scenes import TrainingScene, training_scene
from train.evaluation.metrics import (
    Lead,
    ViewScore,
    fraction_better,
    lead,
    score_view,
    summarize_scores,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class ValidationScene:
    """Scene of the validation split, with the targets and masks of its scores."""

    scene: TrainingScene
    """Tensors of the scene, with targets as log10(1 + radiance)."""
    target_VRR3: NDArray[np.float64]
    """Linear radiance of the targets."""
    hits_VRR: NDArray[np.bool_]
    """True for pixels that see geometry (`hit_masks`)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ValidationResult:
    """Pictures and scores of a network on the validation split."""

    pictures: tuple[NDArray[np.float64], ...]
    """[V, R, R, 3] linear radiance of each scene."""
    views: tuple[ViewScore, ...]
    """Scores of all views, scene after scene."""
    scores: dict[str, float]
    """Summary (evaluation.metrics), and `better_than_median`: the fraction of views won."""
    lead: Lead
    """Advantage of the network over the median picture."""


class Judge:
    """Validation scenes, and the scores of the median picture on them."""

    def __init__(self, samples: Sequence[Sample], resolution: int, median_RR3: NDArray) -> None:
        self.scenes = [validation_scene(sample, resolution) for sample in samples]
        stills = [np.broadcast_to(median_RR3, scene.target_VRR3.shape) for scene in self.scenes]
        self.median_views = score_pictures(stills, self.scenes)
        self.median_scores = summarize_scores(self.median_views)

    def judge(
        self, model: RenderFormer, between: Callable[[], None] = lambda: None
    ) -> ValidationResult:
        """Score a network on all scenes.

        Args:
            between: called before each scene is rendered and before it is scored; an exception
                ends the validation.
        """
        pictures = []
        views = []
        for judged in self.scenes:
            between()
            pictures.append(predict(model, judged.scene))
        for picture, judged in zip(pictures, self.scenes, strict=True):
            between()
            views += score_pictures([picture], [judged])
        scores = summarize_scores(views)
        scores["better_than_median"] = fraction_better(views, self.median_views)
        sizes = [len(scene.target_VRR3) for scene in self.scenes]
        validation_lead = lead(views, self.median_views, sizes)
        return ValidationResult(
            pictures=tuple(pictures), views=tuple(views), scores=scores, lead=validation_lead
        )


def validation_scene(sample: Sample, resolution: int) -> ValidationScene:
    """Return a sample with targets and hit masks, at the resolution of the run."""
    scene = training_scene(sample, resolution)
    return ValidationScene(
        scene=scene,
        target_VRR3=radiance_from_log10(scene.target_VRR3.double().numpy()),
        hits_VRR=hit_masks(sample.scene, resolution),
    )


@torch.no_grad()
def predict(model: RenderFormer, scene: TrainingScene) -> NDArray[np.float64]:
    """Return the pictures of one scene, linear radiance [V, R, R, 3] of at least 0.

    The network computes in float32, on its own device.
    """
    device = next(model.parameters()).device
    batch = collate_batch([scene]).to(device)
    log10_VRR3 = model(batch.scenes, scene.target_VRR3.shape[1])[0]
    return np.maximum(radiance(log10_VRR3.double()).cpu().numpy(), 0)


def score_pictures(
    pictures: Sequence[NDArray], judged: Sequence[ValidationScene]
) -> list[ViewScore]:
    """Score the pictures [V, R, R, 3] of each scene, view by view."""
    return [
        score_view(picture, target, hits)
        for pictures_VRR3, entry in zip(pictures, judged, strict=True)
        for picture, target, hits in zip(
            pictures_VRR3, entry.target_VRR3, entry.hits_VRR, strict=True
        )
    ]


def hit_masks(scene: Scene, resolution: int) -> NDArray[np.bool_]:
    """Return masks [V, R, R] of pixels whose central ray hits a triangle.

    Emitters do not count, since they are hidden from the camera.
    """
    views = range(scene.num_views)
    return np.stack([first_hits(scene, view=view, resolution=resolution).met for view in views])
