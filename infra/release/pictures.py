"""Pictures of a release: the dataset's, the network's, and those of few samples."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from infra.render.cameras import own_camera
from infra.render.engines import Engine, MitsubaPlan, NeuralPlan
from model.weights import MAX_LIGHTS
from pipeline.documents.scene_choice import ChosenScene, choose_scenes, read_chosen
from pipeline.renders.preview import PreviewSettings
from pipeline.renders.variant import choose_variant
from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.sample import Sample

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
    by_width: dict[int, Mapping[str, Engine]] = {}
    with contextlib.ExitStack() as stack:
        for entry, sample in read_chosen(dataset, chosen):
            width = int(sample.radiance_rgb.shape[1])
            if width not in by_width:
                by_width[width] = _engines(width, checkpoint)
                for engine in by_width[width].values():
                    stack.callback(engine.close)
            yield _compare_scene(sample, entry.split, by_width[width])
            done()


def _engines(resolution: int, checkpoint: str) -> Mapping[str, Engine]:
    variant = choose_variant()
    tracers = {
        f"{spp} {'sample' if spp == 1 else 'samples'}, filtered": MitsubaPlan(
            settings=PreviewSettings(resolution=resolution, spp=spp),
            seed=0,
            threads=1,
            variant=variant,
        )
        for spp in RIVALS
    }
    network = NeuralPlan(
        checkpoint=checkpoint,
        precision="float32",
        resolution=resolution,
        lights_per_pass=MAX_LIGHTS,
        threads=None,
    )
    started = {NETWORK: network.start(_ignore_samples)}
    return started | {name: plan.start(_ignore_samples) for name, plan in tracers.items()}


def _ignore_samples(_sampling: object) -> None:
    """Ignore the progress of the samples."""


def _compare_scene(sample: Sample, split: str, engines: Mapping[str, Engine]) -> SceneComparison:
    camera = own_camera(sample.scene, 0)
    target = sample.radiance_rgb[0]
    pictures = {
        name: engine.open(sample.scene, sample.key).render(camera, sample.key).radiance_rgb
        for name, engine in engines.items()
    }
    template = sample.scene.provenance.get("template", "")
    return SceneComparison(
        key=sample.key,
        caption=f"{split}, {template}, {sample.scene.num_triangles} triangles",
        target_rgb=target,
        floor_db=float(sample.views[0].noise_floor_db),
        pictures_rgb=pictures,
        psnr_db={name: float(psnr_log_db(picture, target)) for name, picture in pictures.items()},
    )
