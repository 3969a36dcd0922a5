"""Laws of one step: a mean over views, whatever the batches; what is not finite changes nothing."""

import copy
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.train.kit import tiny_run
from tests.train.toy import toy_sample
from train.data.buckets import TrainingBatch, bucket_scenes, make_batch
from train.data.scenes import training_scene
from train.loop.optim import learning_rate
from train.loop.state import TrainState, new_state
from train.loop.step import StepReport, train_step, view_losses

RESOLUTION = 16


def scenes(count: int = 5) -> list:
    return [training_scene(toy_sample(index), RESOLUTION) for index in range(count)]


def step(state: TrainState, batches: list[TrainingBatch], grad_clip: float = 1.0) -> StepReport:
    return train_step(
        state.model,
        state.optimizer,
        batches,
        resolution=RESOLUTION,
        learning_rate=3e-3,
        grad_clip=grad_clip,
    )


def gradients(batches: list[TrainingBatch]) -> tuple[float, list[Tensor]]:
    state = new_state(tiny_run())
    report = step(state, batches, grad_clip=1e9)
    return report.loss, [w.grad.clone() for w in state.model.parameters() if w.grad is not None]


def test_buckets_of_any_size_give_the_gradient_of_one_batch() -> None:
    drawn = scenes()
    buckets = bucket_scenes(drawn)
    sizes = {len(batch.target_BVRR3) for batch in buckets}
    assert len(sizes) > 1, "equal buckets could not tell a mean over views from one over batches"
    loss, cut = gradients(buckets)
    whole_loss, whole = gradients([make_batch(drawn)])
    # float32 sums in another order
    assert loss == pytest.approx(whole_loss, rel=1e-5)
    for a, b in zip(cut, whole, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


def test_the_loss_is_the_mean_absolute_error_of_each_view() -> None:
    prediction = torch.full((1, 2, 4, 4, 3), -1.0)
    target = torch.zeros(1, 2, 4, 4, 3)
    target[0, 1] = 2.0
    # negative predictions count in full: the ELU is not part of it
    assert view_losses(prediction, target).tolist() == [[1.0, 3.0]]


def ruin_target(state: TrainState, batch: TrainingBatch) -> None:
    batch.target_BVRR3[0, 0, 0, 0, 0] = math.inf


def ruin_weight(state: TrainState, batch: TrainingBatch) -> None:
    with torch.no_grad():
        state.model.decoder.token_W[0] = math.nan


def ruin_gradient(state: TrainState, batch: TrainingBatch) -> None:
    """The loss stays finite; a backward pass that overflows looks like this."""
    state.model.decoder.token_W.register_hook(lambda gradient: gradient * math.inf)


@pytest.mark.parametrize("ruin", [ruin_target, ruin_weight, ruin_gradient])
def test_a_step_that_is_not_finite_changes_nothing(
    ruin: Callable[[TrainState, TrainingBatch], None],
) -> None:
    state = new_state(tiny_run())
    batch = make_batch(scenes(2))
    assert step(state, [batch]).applied
    ruin(state, batch)
    weights = copy.deepcopy(state.model.state_dict())
    memories = copy.deepcopy(state.optimizer.state_dict()["state"])
    report = step(state, [batch])
    assert not report.applied
    for name, weight in state.model.state_dict().items():
        assert torch.equal(weight.nan_to_num(), weights[name].nan_to_num()), name
    for row, memory in state.optimizer.state_dict()["state"].items():
        for name, value in memory.items():
            assert torch.equal(value, memories[row][name]), name


def test_a_long_gradient_is_shortened() -> None:
    batch = make_batch(scenes(2))
    lengths = []
    for clip in (1e-3, 1e9):
        state = new_state(tiny_run())
        report = step(state, [batch], grad_clip=clip)
        grads = [w.grad.flatten() for w in state.model.parameters() if w.grad is not None]
        lengths.append((report.grad_norm, torch.cat(grads).norm().item()))
    (free, shortened), (free_again, unclipped) = lengths
    assert free == pytest.approx(free_again, rel=1e-5)  # float32 norm
    assert shortened == pytest.approx(1e-3, rel=1e-3)  # clip_grad_norm_ divides by norm + 1e-6
    assert unclipped == pytest.approx(free, rel=1e-5)


def test_the_rate_rises_to_its_peak_and_falls_to_its_end_once() -> None:
    settings = tiny_run(num_steps=100, warmup_steps=10, final_rate_share=0.1)
    rates = [learning_rate(step, settings) for step in range(100)]
    assert 0 < rates[0] < rates[9] < settings.learning_rate
    assert rates[10] == settings.learning_rate
    assert rates[99] == pytest.approx(0.1 * settings.learning_rate)
    assert rates[:11] == sorted(set(rates[:11]))
    assert rates[10:] == sorted(set(rates[10:]), reverse=True)
    assert learning_rate(500, settings) == rates[99], "no restart after the end"


def test_a_fresh_network_learns_eight_pictures() -> None:
    """A zero start with the loss behind the ELU stays black; ours must leave black at once.

    Four scenes of two views each, over and over: the pictures must become better than the best
    fixed one, which is their median.
    """
    state = new_state(tiny_run())
    drawn = scenes(4)
    targets = torch.cat([scene.target_VRR3 for scene in drawn])
    median_error = (targets - targets.median(dim=0).values).abs().mean().item()
    reports = [step(state, bucket_scenes(drawn), grad_clip=1.0) for _ in range(150)]
    assert reports[0].loss == pytest.approx(targets.mean().item(), rel=1e-4)  # a black start
    assert reports[-1].loss < 0.7 * median_error  # measured: 0.53
    assert min(report.grad_norm for report in reports) > 0.01
