"""Training a network that is told hits: it resumes to the bit, and any crew traces alike."""

import dataclasses
from contextlib import closing
from pathlib import Path

import pytest
import torch

from model.hits.traced import INPUTS
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import open_training_data
from tests.model.hits.test_decoder import hits_config
from tests.train.kit import tiny_run, trained
from tests.train.toy import write_toy_dataset
from train.data.order import RankShare
from train.data.scenes import TrainingScene
from train.data.stream import stream_batches
from train.data.unusable import Unusable
from train.run import stream_settings
from train.settings import AugmentationSettings, TrainSettings

AUGMENTATION = AugmentationSettings(
    rotation="uniform", mirror=True, channels=True, vertex_order=True, withheld_inputs=0.3
)


def hits_run(**changes: object) -> TrainSettings:
    run = tiny_run(model=hits_config(), run="tiny-hits", augmentation=AUGMENTATION)
    return dataclasses.replace(run, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=7, validation=2, per_shard=3)


def _first_batch(dataset: Dataset, workers: int, rank: int = 0, of: int = 1) -> list[TrainingScene]:
    batches = stream_batches(
        open_training_data([str(dataset.folder.root)]).split("train"),
        stream_settings(hits_run()),
        3,
        share=RankShare(rank=rank, world_size=of),
        workers=workers,
        unusable=Unusable(0),
    )
    with closing(batches):
        return next(batches)


def test_what_is_traced_depends_on_no_thread_and_no_rank(dataset: Dataset) -> None:
    alone = {scene.key: scene.tensors.traced for scene in _first_batch(dataset, workers=1)}
    for rank in range(3):
        (other,) = _first_batch(dataset, workers=3, rank=rank, of=3)
        a, b = alone.pop(other.key), other.tensors.traced
        assert a is not None
        assert b is not None
        for name, value in vars(a).items():
            assert torch.equal(value, getattr(b, name)), name


def test_views_are_traced_after_the_symmetries_and_lack_inputs_by_chance(dataset: Dataset) -> None:
    scenes = _first_batch(dataset, workers=1)
    given = torch.cat([s.tensors.traced.given_VI for s in scenes if s.tensors.traced])
    assert given.shape == (6, len(INPUTS))
    assert 0 < given.mean() < 1
    for scene in scenes:
        traced = scene.tensors.traced
        assert traced is not None
        # each pixel that is lit in the picture, mirrored as it is, is one that meets something
        lit = scene.target_VRR3.amax(dim=-1) > 0.01
        assert (traced.pixels_VRRC[..., 0] > 0)[lit].float().mean() > 0.95


def test_a_run_that_was_stopped_ends_like_one_that_was_not(
    dataset: Dataset, tmp_path: Path
) -> None:
    data = [str(dataset.folder.root)]
    run = hits_run(num_steps=3, validate_every=4, checkpoint_every=2)
    whole = trained(run, data, tmp_path)
    weights = whole.folder.weights.read_bytes()
    (tmp_path / "checkpoints/step-000000003.safetensors").unlink()
    whole.folder.weights.unlink()
    again = trained(run, data, tmp_path, resume=True)
    assert again.folder.weights.read_bytes() == weights
