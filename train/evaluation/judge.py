"""The validation split, its simplest rival, and how a network stands between the two."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from model.renderformer import RenderFormer, radiance
from storage.conventions import radiance_from_log10
from storage.records.first_hits import first_hits
from storage.records.sample import Sample
from storage.records.scene import Scene
from train.data.buckets import make_batch
from train.data.scenes import TrainingScene, training_scene
from train.evaluation.scores import Lead, ViewScore, lead, score_view, share_better, summarise


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgedScene:
    """One scene of the validation split, with what its pictures are judged by."""

    scene: TrainingScene
    """Tensors and targets."""
    target_VRR3: NDArray[np.float64]
    """Linear radiance."""
    hits_VRR: NDArray[np.bool_]
    """Which pixels see geometry (`hit_masks`)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ValidationJudgement:
    """How a network did on the validation split."""

    pictures: tuple[NDArray[np.float64], ...]
    """[V, R, R, 3] linear radiance of each scene."""
    views: tuple[ViewScore, ...]
    """Scene by scene, view by view."""
    scores: dict[str, float]
    """evaluation.scores.summarise, and `better_than_median`: the share of views won."""
    lead: Lead
    """Advantage of the network over the median picture."""


class Judge:
    """Holds the validation scenes and the median picture's scores on them."""

    def __init__(self, samples: Sequence[Sample], resolution: int, median_RR3: NDArray) -> None:
        self.scenes = [judged_scene(sample, resolution) for sample in samples]
        stills = [np.broadcast_to(median_RR3, scene.target_VRR3.shape) for scene in self.scenes]
        self.median_views = score_pictures(stills, self.scenes)
        self.median_scores = summarise(self.median_views)

    def judge(
        self, model: RenderFormer, between: Callable[[], None] = lambda: None
    ) -> ValidationJudgement:
        """Judge a network on all scenes.

        Args:
            model: the network.
            between: called before each scene is rendered and before it is judged; what it raises
                ends the judging.
        """
        pictures, views = [], []
        for judged in self.scenes:
            between()
            pictures.append(predict(model, judged.scene))
        for picture, judged in zip(pictures, self.scenes, strict=True):
            between()
            views += score_pictures([picture], [judged])
        scores = summarise(views)
        scores["better_than_median"] = share_better(views, self.median_views)
        sizes = [len(scene.target_VRR3) for scene in self.scenes]
        ahead = lead(views, self.median_views, sizes)
        return ValidationJudgement(
            pictures=tuple(pictures), views=tuple(views), scores=scores, lead=ahead
        )


def judged_scene(sample: Sample, resolution: int) -> JudgedScene:
    """Return a sample with what its pictures are judged by, at the resolution of the run."""
    scene = training_scene(sample, resolution)
    return JudgedScene(
        scene=scene,
        target_VRR3=radiance_from_log10(scene.target_VRR3.double().numpy()),
        hits_VRR=hit_masks(sample.scene, resolution),
    )


@torch.no_grad()
def predict(model: RenderFormer, scene: TrainingScene) -> NDArray[np.float64]:
    """Return the finished pictures of one scene, linear radiance [V, R, R, 3] of at least 0.

    In float32, wherever the network is.
    """
    device = next(model.parameters()).device
    batch = make_batch([scene]).to(device)
    log10_VRR3 = model(batch.scenes, scene.target_VRR3.shape[1])[0]
    return np.maximum(radiance(log10_VRR3.double()).cpu().numpy(), 0)


def score_pictures(pictures: Sequence[NDArray], judged: Sequence[JudgedScene]) -> list[ViewScore]:
    """Judge [V, R, R, 3] of each scene, view by view."""
    return [
        score_view(picture, target, hits)
        for pictures_VRR3, entry in zip(pictures, judged, strict=True)
        for picture, target, hits in zip(
            pictures_VRR3, entry.target_VRR3, entry.hits_VRR, strict=True
        )
    ]


def hit_masks(scene: Scene, resolution: int) -> NDArray[np.bool_]:
    """Return [V, R, R]: whether the ray through the pixel's centre hits a triangle.

    Emitters do not count, as they are hidden from the camera.
    """
    views = range(scene.num_views)
    return np.stack([first_hits(scene, view=view, resolution=resolution).met for view in views])
