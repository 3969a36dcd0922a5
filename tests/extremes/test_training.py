"""Training at the ends of targets, losses, weights and symmetries: finite, or a skipped step."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from storage.conventions import HALF_FLOAT_MAX
from tests.train.kit import tiny_run
from tests.train.loop.test_step import stepper
from tests.train.toy import toy_sample, toy_scene
from train.data.augment import augmented
from train.data.buckets import TrainingBatch, make_batch
from train.data.scenes import training_scene
from train.loop.state import new_state
from train.loss.objective import Objective
from train.settings import AugmentationSettings, LossSettings

RESOLUTION = 16
BRIGHTEST = math.log10(1 + HALF_FLOAT_MAX)
"""The largest target: pictures are stored as half floats."""

TERMS = [
    LossSettings(perceptual="none"),
    LossSettings(perceptual="ms_ssim"),
    LossSettings(perceptual="none", noise_half=1e-6),
    LossSettings(perceptual="none", noise_half=10.0),
]


def batch(**changes: Tensor) -> TrainingBatch:
    """Return two toy scenes, with other targets or noise."""
    scenes = [training_scene(toy_sample(index), RESOLUTION) for index in range(2)]
    return dataclasses.replace(make_batch(scenes), **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("terms", TERMS)
def test_every_target_that_can_be_stored_gives_a_step(terms: LossSettings) -> None:
    usual, run = batch(), tiny_run(loss=terms)
    for target, noise in ((0.0, 0.0), (0.0, 10.0), (1e-7, 1e-5), (BRIGHTEST, 0.0)):
        ends = dataclasses.replace(
            usual,
            target_BVRR3=torch.full_like(usual.target_BVRR3, target),
            noise_BV=torch.full_like(usual.noise_BV, noise),
        )
        state = new_state(run)
        report = stepper(state, run).step([ends], 1e-3)
        finite = math.isfinite(report.loss) and math.isfinite(report.grad_norm)
        assert report.applied and finite, (target, noise)
        assert all(torch.isfinite(weight).all() for weight in state.model.parameters())


@given(
    shown=st.floats(-40, 40, width=32),
    wanted=st.floats(0, BRIGHTEST),
    noise=st.floats(0, 100, width=32),
    terms=st.sampled_from(TERMS),
)
@settings(max_examples=40, deadline=None)
def test_losses_and_their_gradients_are_finite_wherever_predictions_are(
    shown: float, wanted: float, noise: float, terms: LossSettings
) -> None:
    size = (1, 1, 32, 32, 3)
    prediction = torch.full(size, shown, requires_grad=True)
    losses = Objective(terms, None)(prediction, torch.full(size, wanted), torch.full((1, 1), noise))
    losses.total_BV.sum().backward()
    assert prediction.grad is not None and torch.isfinite(prediction.grad).all()
    assert losses.total_BV.item() >= 0


def test_a_weight_beyond_float32_skips_the_step_and_the_next_one_is_as_before() -> None:
    run = tiny_run()
    state, kept = new_state(run), new_state(run)
    with torch.no_grad():
        state.model.decoder.head.last.weight.fill_(3e38)
    report = stepper(state, run).step([batch()], 1e-3)
    assert not report.applied
    state.model.load_state_dict(kept.model.state_dict())
    again, first = (stepper(each, run).step([batch()], 1e-3) for each in (state, kept))
    assert again == first


@pytest.mark.parametrize("factor", [1.0, 30.0, 1e3])
def test_light_may_be_scaled_as_far_as_half_floats_hold(factor: float) -> None:
    scene = training_scene(toy_sample(0), RESOLUTION)
    changed = augmented(scene, AugmentationSettings(light_scale=factor), np.random.default_rng(0))
    assert torch.isfinite(changed.target_VRR3).all() and changed.target_VRR3.min() >= 0
    report = stepper(new_state(tiny_run()), tiny_run()).step([make_batch([changed])], 1e-3)
    assert report.applied


def test_a_scene_of_its_light_alone_is_a_step() -> None:
    whole = toy_sample(0)
    scene = toy_scene(0, boxes=0)
    alone = dataclasses.replace(
        scene,
        faces=scene.faces[-1:],
        material_index=scene.material_index[-1:],
        object_index=scene.object_index[-1:],
    )
    lonely = training_scene(dataclasses.replace(whole, scene=alone), RESOLUTION)
    run = tiny_run()
    report = stepper(new_state(run), run).step([make_batch([lonely])], 1e-3)
    assert report.applied


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_both_precisions_take_the_brightest_and_the_darkest(precision: str) -> None:
    ends = batch()
    for target in (0.0, BRIGHTEST):
        run = tiny_run(precision=precision)
        state = new_state(run)
        bright = batch(target_BVRR3=torch.full_like(ends.target_BVRR3, target))
        assert stepper(state, run).step([bright], 1e-3).applied
