"""Symmetries of scenes below a sky: what is traced of them is what the symmetry says."""

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model.hits.radiosity import scene_light
from model.hits.tracing import lit_scene_of
from model.hits.view_inputs import Channel, view_inputs
from model.scene_tensors import SceneTensors, scene_tensors
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from storage.records.stored_sample import StoredSample, stored_sample
from tests.for_each import for_each
from tests.model.hits.kit import corner
from tests.model.hits.test_decoder import hits_config
from tests.model.kit import tiny_config
from tests.sky_maps import smooth
from tests.train.toy import toy_sample
from train.data.augment import mirrored, moved, rotation_rand, with_channels, with_light_scaled
from train.data.scenes import TrainingScene
from train.data.stream import StreamSettings, _SceneMaker
from train.data.unusable import Unusable

ORDER = np.array([2, 0, 1])


def _direct(tensors: SceneTensors) -> NDArray:
    """Return the mean of the direct light of several noises, at four pixels by four."""
    lit = lit_scene_of(tensors)
    light = scene_light(lit)
    total = np.zeros((32, 32, 3), np.float32)
    for seed in range(6):
        found = view_inputs(
            lit, light, tensors.c2w_V44[0].numpy(), float(tensors.fov_deg_V[0]), 32,
            rays_a_side=2, anchors_a_side=8, gather_rays=0, sky_rays=8, seed=seed,
        ).pixels  # fmt: skip
        total += found[..., Channel.SHOWN_DIFFUSE] / 6
    return total.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3))


@for_each("symmetry", ["moved", "mirrored", "channels", "scaled"])
def test_a_sky_goes_through_the_symmetries_of_training(symmetry: str) -> None:
    tensors = scene_tensors(corner(sky=smooth(), radiance=0.0))
    training = TrainingScene(
        key="",
        tensors=tensors,
        target_VRR3=torch.zeros(1, 4, 4, 3),
        noise_V=torch.zeros(1),
        light_T=torch.zeros(tensors.num_triangles, dtype=torch.int64),
    )
    before = _direct(tensors)
    if symmetry == "moved":
        rotation = rotation_rand("uniform", np.random.default_rng(0))
        after = _direct(moved(training, rotation, torch.tensor([0.4, -0.1, 0.2])).tensors)
    elif symmetry == "mirrored":
        after = _direct(mirrored(training).tensors)[:, ::-1]
    elif symmetry == "channels":
        after = _direct(with_channels(training, ORDER).tensors)
        before = before[..., ORDER]
    else:
        after = _direct(with_light_scaled(training, 3.0).tensors) / np.float32(3)
    # The noise goes along, but behind a mirror: there 48 rays and more of 16 pixels differ by 3 %.
    most = 0.06 if symmetry == "mirrored" else 0.005
    assert before.std() > 0.05
    assert np.median(np.abs(after / np.maximum(before, 1e-3) - 1)[before > 0.05]) < most
    assert after.mean() == pytest.approx(before.mean(), rel=most / 4)


def _below_a_sky() -> StoredSample:
    sample = toy_sample(0)
    below = dataclasses.replace(sample.scene, environment=smooth())
    return stored_sample("0", encode_sample(dataclasses.replace(sample, scene=below)))


@for_each(
    ("config", "is_known"),
    [
        (tiny_config(), False),
        (hits_config(), False),
        (hits_config(sky_rays=2), True),
    ],
)
def test_training_takes_skies_that_its_network_knows(config: object, is_known: bool) -> None:
    settings = StreamSettings(
        seed=0, window=1, batch_size=1, resolution=16, views_per_scene=1, network=config  # type: ignore[arg-type]
    )  # fmt: skip
    rng = np.random.default_rng(0)
    maker = _SceneMaker(None, None, settings, Unusable(0))  # type: ignore[arg-type]
    if is_known:
        assert maker._drawn(_below_a_sky(), rng).tensors.sky is not None
        return
    with pytest.raises(TrilightError, match="this network does not know its light"):
        maker._drawn(_below_a_sky(), rng)
