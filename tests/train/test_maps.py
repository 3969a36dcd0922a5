"""Training below skies and on textures: from shards to weights, and to the bit after a stop."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.records.retextured import with_textures
from storage.records.scene import Scene
from storage.records.texture import Texture
from tests.model.hits.test_decoder import hits_config
from tests.model.kit import tiny_config
from tests.sky_maps import smooth
from tests.train.kit import tiny_run, trained
from tests.train.toy import toy_scene, write_toy_dataset
from train.settings import AugmentationSettings, TrainSettings

AUGMENTATION = AugmentationSettings(
    rotation="uniform", mirror=True, channels=True, vertex_order=True, light_scale=2.0
)


def _scene(index: int) -> Scene:
    """Return a toy scene: two in three below a sky, two in three with a texture."""
    scene = toy_scene(index)
    if index % 3 != 1:
        scene = dataclasses.replace(scene, environment=smooth(8))
    if index % 3:
        rng = np.random.default_rng(index)
        texture = Texture(texels=rng.integers(0, 90, (8, 8, 3), np.uint8))
        rows = np.full((len(scene.materials), 3), -1, np.int32)
        rows[scene.material_index[~scene.triangle_emits][0], 0] = 0
        uv = scene.vertex_positions[scene.faces.ravel(), :2].astype(np.float32)
        scene = with_textures(scene, uv, (texture,), rows)
    return scene


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("maps")
    return write_toy_dataset(folder, train=6, validation=2, per_shard=3, scene_of=_scene)


def _run() -> TrainSettings:
    run = tiny_run(model=hits_config(sky_rays=2), run="tiny-maps", augmentation=AUGMENTATION)
    return dataclasses.replace(run, num_steps=4, validate_every=4, checkpoint_every=2)


@pytest.mark.slow("training")
def test_a_run_that_was_stopped_ends_like_one_that_was_not(
    dataset: Dataset, tmp_path: Path
) -> None:
    """With steps in which no scene has a sky, or a texture."""
    data = [str(dataset.folder.root)]
    run = _run()
    weights = trained(run, data, tmp_path).folder.weights.read_bytes()
    (tmp_path / "checkpoints/step-000000004.safetensors").unlink()
    (tmp_path / "model.safetensors").unlink()
    assert trained(run, data, tmp_path, resume=True).folder.weights.read_bytes() == weights


def test_a_run_that_knows_no_sky_is_refused_before_its_first_step(
    dataset: Dataset, tmp_path: Path
) -> None:
    run = dataclasses.replace(_run(), model=tiny_config())
    with pytest.raises(TrilightError, match=r"does not know its light.*model.sky_rays=16"):
        trained(run, [str(dataset.folder.root)], tmp_path / "run")
    assert not list((tmp_path / "run").glob("checkpoints/*"))
