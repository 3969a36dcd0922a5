"""Pictures of a release: the dataset's, the network's, and those of few samples."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from infra.render.networks import NetworkRenderer
from infra.render.path_tracer import PathTracer, RenderChild
from infra.render.quality import FixedSamples
from pipeline.documents.scene_choice import ChosenScene, choose_scenes, read_chosen
from pipeline.renders.variant import choose_variant
from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.records.sample import Sample
from storage.renderer import Camera, Renderer
from train.evaluation.evaluate import judge_view
from train.evaluation.judge import validation_scene
from train.evaluation.pairs import METRIC

RIVALS = (1, 4, 16)
"""Samples per pixel of the previews in the comparison, filtered by Open Image Denoise."""

NETWORK = "network"


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneComparison:
    """First view of one scene, rendered by all methods."""

    key: str
    """Key of the scene's sample in the dataset."""
    caption: str
    """Split, layout and number of triangles as text."""
    target_rgb: NDArray[np.float32]
    """[R, R, 3] linear radiance of the dataset's picture."""
    floor_db: float
    """Stated error of the target as psnr_log_db."""
    pictures_rgb: Mapping[str, NDArray[np.float32]]
    """[R, R, 3] linear radiance by method."""
    psnr_db: Mapping[str, float]
    """psnr_log_db to the target by method."""


def chosen_scenes(dataset: Dataset, count: int) -> list[ChosenScene]:
    """Return up to `count` scenes of the test split, or of all splits if it is empty.

    Raises:
        TrilightError: `count` is below 1, or the dataset is empty.
    """
    judged = any(shard.num_samples for shard in dataset.shards_of("test"))
    splits = ("test",) if judged else SPLITS
    if count < 1 or not (chosen := choose_scenes(dataset, count, splits)):
        raise TrilightError(
            f"--pictures is {count}, of a dataset of {dataset.manifest.num_samples} scenes; "
            "expected at least one scene to show."
        )
    return chosen


def compare_scenes(
    dataset: Dataset, chosen: Sequence[ChosenScene], *, checkpoint: str, done: Callable[[], None]
) -> Iterator[SceneComparison]:
    """Yield the comparison of each scene's first view.

    Args:
        dataset: dataset of the scenes.
        chosen: scenes to compare.
        checkpoint: network, as in `trilight render --checkpoint`.
        done: called after each scene.

    Raises:
        TrilightError: a sample is unreadable, or the network or the path tracer cannot render it.
    """
    with contextlib.closing(RenderChild(choose_variant(), threads=1)) as child:
        by_width: dict[int, Sequence[Renderer]] = {}
        for entry, sample in read_chosen(dataset, chosen):
            width = int(sample.radiance_rgb.shape[1])
            if width not in by_width:
                by_width[width] = _renderers(child, width, checkpoint)
            yield _compare_scene(sample, entry.split, by_width[width])
            done()


def _renderers(child: RenderChild, resolution: int, checkpoint: str) -> Sequence[Renderer]:
    network = NetworkRenderer(name=NETWORK, checkpoint=checkpoint, resolution=resolution)
    samples = [
        PathTracer(
            child,
            FixedSamples(spp=spp, denoiser="fast"),
            resolution,
            name=f"{spp} {'sample' if spp == 1 else 'samples'}, filtered",
        )
        for spp in RIVALS
    ]
    return [network, *samples]


def _compare_scene(sample: Sample, split: str, renderers: Sequence[Renderer]) -> SceneComparison:
    camera = Camera.of_scene(sample.scene, 0)
    target = sample.radiance_rgb[0]
    pictures = {
        each.name: each.load(sample.scene, sample.key).render(camera).radiance_rgb
        for each in renderers
    }
    row = judge_view(sample, validation_scene(sample, len(target)), 0, pictures, None)
    return SceneComparison(
        key=row.key,
        caption=f"{split}, {row.template}, {row.num_triangles} triangles",
        target_rgb=target,
        floor_db=row.floors[METRIC],
        pictures_rgb=pictures,
        psnr_db={name: scores[METRIC] or 0.0 for name, scores in row.scores.items()},
    )
