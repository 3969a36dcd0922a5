"""Validation of a network against targets and baselines that ignore the scene.

A network that does not beat the baselines has learned nothing. The nearest training view is the
training picture closest to the target itself. No method that looks up a training picture by the
scene can do better.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from model.renderformer import RenderFormer, radiance
from model.scene_tensors import SceneTensors, batch_scenes, map_tensors
from storage.conventions import log10_radiance, radiance_from_log10
from storage.errors import TrilightError
from storage.raycast import first_hits
from storage.records.sample import Sample
from storage.renderer import fingerprint
from train.data.scenes import TrainingScene, block_mean, training_scene
from train.evaluation.metrics import (
    VALIDATED,
    Lead,
    Scores,
    fraction_better,
    lead,
    picture_scores,
    summarize_scores,
)
from train.evaluation.sheet import SheetView, draw_sheet
from train.settings import TrainSettings

MEDIAN = "median picture"
NEAREST = "nearest training view"

COMPARED_PX = 32
"""Maximum width in pixels at which pictures are compared."""


class Baselines:
    """Baseline pictures from some training scenes."""

    def __init__(self, scenes: Iterable[TrainingScene]) -> None:
        # half floats take half the memory, and an error of a thousandth does not matter here
        named = [(scene.key, scene.target_VRR3.numpy().astype(np.float16)) for scene in scenes]
        self._keys_M = np.array([key for key, pictures in named for _ in pictures])
        self._log10_MRR3 = np.concatenate([pictures for _, pictures in named])
        self._small_MRR3 = _small(self._log10_MRR3)

    @functools.cached_property
    def _median_RR3(self) -> NDArray[np.float64]:
        return median_picture([self._log10_MRR3])

    def pictures(self, target_rgb: NDArray) -> dict[str, NDArray[np.float64]]:
        """Return each baseline's picture for a target [R, R, 3], linear radiance."""
        return {MEDIAN: self._median_RR3, NEAREST: self.nearest(target_rgb)}

    def nearest(self, target_rgb: NDArray, *, not_of: str = "") -> NDArray[np.float64]:
        """Return the training picture [R, R, 3] that is closest to a target, linear radiance.

        Args:
            target_rgb: [R, R, 3] linear radiance.
            not_of: key of a scene whose pictures are excluded.

        Raises:
            TrilightError: all pictures are of that scene.
        """
        small = _small(log10_radiance(target_rgb)[None])
        distance_M = np.abs(self._small_MRR3 - small).mean(axis=(1, 2, 3))
        is_other_M = self._keys_M != not_of
        if not is_other_M.any():
            raise TrilightError(
                f"nearest view: scene {not_of} is alone; expected a second scene to look up."
            )
        nearest = int(np.where(is_other_M, distance_M, np.inf).argmin())
        return radiance_from_log10(self._log10_MRR3[nearest].astype(np.float64))


def median_picture(log10_pictures: Sequence[NDArray]) -> NDArray[np.float64]:
    """Return the per-pixel median radiance [R, R, 3] over all views.

    No other fixed picture has a smaller L1 error, in any monotonic space.

    Args:
        log10_pictures: log10(1 + radiance) of the views [V, R, R, 3] of each scene.
    """
    median_RR3 = np.median(np.concatenate(log10_pictures), axis=0)
    return radiance_from_log10(median_RR3.astype(np.float64))


def _small(log10_MRR3: NDArray) -> NDArray[np.float32]:
    resolution = log10_MRR3.shape[1]
    factor = max(resolution // COMPARED_PX, 1)
    width = resolution // factor
    cropped = log10_MRR3[:, : width * factor, : width * factor].astype(np.float32)
    return block_mean(cropped, width)


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureSource:
    """Pictures of one width, by the scene's key and the camera's row."""

    name: str
    """Name of the row, unique on a leaderboard."""
    resolution: int
    """Width and height of the pictures in pixels."""
    digest: Callable[[str, int], str]
    """Returns the digest of everything that decides the picture of a view."""
    pictures: Callable[[Sample], NDArray[np.floating]]
    """Returns the pictures [V, R, R, 3] of a sample, linear radiance of at least 0."""


def nearest_view(
    name: str, resolution: int, read: Callable[[], Baselines], *, pool: str, not_itself: bool
) -> PictureSource:
    """Return the lookup of the picture of another scene that is nearest to the target.

    It is the bound of any lookup: it uses the target itself, so that no method that looks up a
    picture by the scene can be better.

    Args:
        read: returns the pictures of the lookup; called when the first one is needed.
        pool: digest of the dataset of these pictures.
        not_itself: whether the evaluated scenes are among them.
    """
    baselines = functools.cache(read)

    def pictures(sample: Sample) -> NDArray[np.floating]:
        targets = block_mean(sample.radiance_rgb, resolution)
        itself = sample.key if not_itself else ""
        return np.stack([baselines().nearest(target, not_of=itself) for target in targets])

    digest = fingerprint({"pool": pool})
    return PictureSource(
        name=name, resolution=resolution, digest=lambda key, view: digest, pictures=pictures
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ValidationScene:
    """Scene of the validation split, with the targets and masks of its scores."""

    scene: TrainingScene
    """Tensors of the scene, with targets as log10(1 + radiance)."""
    target_VRR3: NDArray[np.float64]
    """Linear radiance of the targets."""
    hits_VRR: NDArray[np.bool_]
    """True for pixels whose central ray hits a triangle other than emitters, which are hidden."""

    def scores(self, pictures_VRR3: NDArray) -> list[Scores]:
        """Score pictures [V, R, R, 3] of linear radiance by VALIDATED, view by view."""
        views = zip(pictures_VRR3, self.target_VRR3, self.hits_VRR, strict=True)
        every = [picture_scores(*view, None, VALIDATED) for view in views]
        return [{name: score or 0.0 for name, score in scores.items()} for scores in every]


@dataclass(frozen=True, kw_only=True, eq=False)
class ValidationResult:
    """Pictures and scores of a network on the validation split."""

    pictures: tuple[NDArray[np.float64], ...]
    """[V, R, R, 3] linear radiance of each scene."""
    views: tuple[Scores, ...]
    """Scores of all views, scene after scene."""
    scores: dict[str, float]
    """Summary (evaluation.metrics), and `better_than_median`: the fraction of views won."""
    lead: Lead
    """Advantage of the network over the median picture."""


class Judge:
    """Validation scenes, and the scores of the median picture on them."""

    def __init__(self, samples: Sequence[Sample], resolution: int, median_RR3: NDArray) -> None:
        self._resolution = resolution
        self.scenes = [validation_scene(sample, resolution) for sample in samples]
        self.median_views = [
            scores
            for scene in self.scenes
            for scores in scene.scores(np.broadcast_to(median_RR3, scene.target_VRR3.shape))
        ]
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
            pictures.append(predict(model, judged.scene.tensors, self._resolution))
            between()
            views += judged.scores(pictures[-1])
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
    hits = [
        first_hits(sample.scene, view=view, resolution=resolution).met
        for view in range(sample.scene.num_views)
    ]
    return ValidationScene(
        scene=scene,
        target_VRR3=radiance_from_log10(scene.target_VRR3.double().numpy()),
        hits_VRR=np.stack(hits),
    )


@torch.no_grad()
def predict(model: RenderFormer, scene: SceneTensors, resolution: int) -> NDArray[np.float64]:
    """Return the pictures of one scene, linear radiance [V, R, R, 3] of at least 0.

    The network computes in float32, on its own device.
    """
    device = next(model.parameters()).device
    batch = map_tensors(batch_scenes([scene]), lambda tensor: tensor.to(device))
    log10_VRR3 = model(batch, resolution)[0]
    return np.maximum(radiance(log10_VRR3.double()).cpu().numpy(), 0)


SHEET_SCENES = 8
"""Maximum number of scenes on a validation sheet, one view each."""


def draw_validation_sheet(
    settings: TrainSettings, judge: Judge, validation: ValidationResult, step: int
) -> Image.Image:
    """Draw the sheet of the first validation scenes after a step."""
    views = []
    at = 0
    scene_pictures = zip(judge.scenes, validation.pictures, strict=True)
    for judged, pictures in list(scene_pictures)[:SHEET_SCENES]:
        score = validation.views[at]
        median = judge.median_views[at]
        at += len(pictures)
        views.append(
            SheetView(
                name=f"scene {judged.scene.key}, view 0",
                scores=(
                    f"log L1 {score['log_l1']:.4f} (median picture {median['log_l1']:.4f}), "
                    f"{score['psnr_log_db']:.1f} dB log, {score['psnr_linear_db']:.1f} dB linear"
                ),
                target_rgb=judged.target_VRR3[0],
                predicted_rgb=pictures[0],
                noise=float(judged.scene.noise_V[0]),
            )
        )
    title = (
        f"run {settings.run}, step {step} of {settings.num_steps}, {settings.resolution} pixels: "
        f"validation scenes, never trained on",
        f"log L1 {validation.scores['log_l1']:.4f}, median picture of the training views "
        f"{judge.median_scores['log_l1']:.4f}, "
        f"{validation.scores['better_than_median']:.0%} of views better than it",
    )
    return draw_sheet(views, title)
