"""Laws of one step: a mean over views, whatever the batches; what is not finite changes nothing."""

import copy
import functools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from model.layers import Norm
from model.renderformer import count_parameters
from tests.for_each import for_each
from tests.model.kit import awake, tiny_config
from tests.train.kit import tiny_run
from tests.train.toy import toy_sample
from train.data.buckets import TrainingBatch, bucket_scenes, make_batch
from train.data.scenes import training_scene
from train.loop.crew import Crew
from train.loop.state import TrainState, new_state
from train.loop.step import Stepper, StepReport, predicted
from train.loss.objective import Objective, view_l1
from train.runs import changed_run
from train.settings import Precision, TrainSettings

RESOLUTION = 16
CPU = torch.device("cpu")


def scenes(count: int = 5) -> list:
    return [training_scene(toy_sample(index), RESOLUTION) for index in range(count)]


def cost(num_triangles: int) -> float:
    return 100.0 + num_triangles


def stepper(state: TrainState, settings: TrainSettings) -> Stepper:
    return Stepper(state, settings, Objective(settings.loss, None), Crew(device=CPU))


def step(state: TrainState, batches: list[TrainingBatch], grad_clip: float = 1.0) -> StepReport:
    report = stepper(state, tiny_run(grad_clip=grad_clip)).step(batches, 3e-3)
    state.step += 1
    return report


def gradients(batches: list[TrainingBatch]) -> tuple[float, list[Tensor]]:
    state = new_state(tiny_run())
    report = step(state, batches, grad_clip=1e9)
    return report.loss, [w.grad.clone() for w in state.model.parameters() if w.grad is not None]


def test_buckets_of_any_size_give_the_gradient_of_one_batch() -> None:
    drawn = scenes()
    buckets = bucket_scenes(drawn, cost, 16)
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
    assert view_l1(prediction, target).tolist() == [[1.0, 3.0]]


def ruin_target(state: TrainState, batch: TrainingBatch) -> None:
    batch.target_BVRR3[0, 0, 0, 0, 0] = math.inf


def ruin_weight(state: TrainState, batch: TrainingBatch) -> None:
    with torch.no_grad():
        state.model.decoder.token_W[0] = math.nan


def ruin_gradient(state: TrainState, batch: TrainingBatch) -> None:
    """The loss stays finite; a backward pass that overflows looks like this."""
    state.model.decoder.token_W.register_hook(lambda gradient: gradient * math.inf)


@for_each(("muon_rate", "precision"), [(0.0, "bfloat16"), (3.0, "bfloat16"), (3.0, "float32")])
@for_each("ruin", [ruin_target, ruin_weight, ruin_gradient])
def test_a_step_that_is_not_finite_changes_nothing(
    ruin: Callable[[TrainState, TrainingBatch], None], muon_rate: float, precision: Precision
) -> None:
    state = new_state(tiny_run(ema_decay=0.5, muon_rate=muon_rate), muon_precision=precision)
    batch = make_batch(scenes(2))
    assert step(state, [batch]).applied
    ruin(state, batch)
    assert state.mean_model is not None
    mean = copy.deepcopy(state.mean_model.state_dict())
    weights = copy.deepcopy(state.model.state_dict())
    memories = copy.deepcopy(state.updater.memories())
    report = step(state, [batch])
    assert not report.applied
    for name, weight in state.model.state_dict().items():
        assert torch.equal(weight.nan_to_num(), weights[name].nan_to_num()), name
    for name, memory in state.updater.memories().items():
        assert torch.equal(memory, memories[name]), name
    for name, weight in state.mean_model.state_dict().items():
        assert torch.equal(weight, mean[name]), name


def test_the_mean_follows_the_weights_faster_at_first() -> None:
    settings = tiny_run(ema_decay=0.5)
    state = new_state(settings)
    assert state.mean_model is not None and state.shown is state.mean_model
    batch = make_batch(scenes(2))
    by_hand = state.model.decoder.rays.weight.detach().clone()
    for updates in range(12):
        stepper(state, settings).step([batch], 3e-3)
        state.step += 1
        decay = min(0.5, (1 + updates) / (10 + updates))
        by_hand = decay * by_hand + (1 - decay) * state.model.decoder.rays.weight.detach()
    # float32, 12 updates
    torch.testing.assert_close(state.mean_model.decoder.rays.weight, by_hand, rtol=0, atol=1e-6)
    assert (by_hand - state.model.decoder.rays.weight).abs().max() > 1e-4
    assert new_state(tiny_run()).shown is not None and new_state(tiny_run()).mean_model is None


def test_bfloat16_rounds_products_but_no_position() -> None:
    """The published training rounds positions too, to a grid of up to 0.004 m."""
    model = new_state(tiny_run()).model
    batch = make_batch(scenes(2))
    seen: dict[str, list[Tensor]] = {}

    def note(precision: Precision) -> Tensor:
        hook = model.encoder.rotary.register_forward_pre_hook(
            lambda _, given: seen.setdefault(precision, []).append(given[0].clone())
        )
        with torch.no_grad():
            model.decoder.head.last.weight.fill_(0.01)  # or all pictures are black alike
            prediction = predicted(model, batch, RESOLUTION, precision)
        hook.remove()
        return prediction

    exact, rounded = note("float32"), note("bfloat16")
    assert rounded.dtype == torch.float32
    assert 0 < (rounded - exact).abs().max() < 0.05
    for ours, theirs in zip(seen["bfloat16"], seen["float32"], strict=True):
        assert ours.dtype == torch.float32 and torch.equal(ours, theirs)


@for_each("family", ["linear", "dpt"])
def test_bfloat16_rounds_neither_rays_nor_materials_nor_the_last_layers(family: str) -> None:
    """As model.precision says; norms keep the type that they get, and layers are rounded."""
    network, found = awake(tiny_config(family), torch.float32), dict[str, str]()

    def note(name: str, module: nn.Module, given: tuple[Tensor, ...], output: Tensor) -> None:
        kept = isinstance(module, Norm) and output.dtype == given[0].dtype
        found[name] = "kept" if kept else str(output.dtype).removeprefix("torch.")

    for name, module in network.named_modules():
        if isinstance(module, Norm | nn.Linear | nn.Conv2d):
            module.register_forward_hook(functools.partial(note, name))
    assert predicted(network, make_batch(scenes(2)), RESOLUTION, "bfloat16").dtype == torch.float32
    exact = {"encoder.tokens.material", "encoder.tokens.normal", "decoder.rays"}
    exact |= {"decoder.head.last"} | ({"decoder.head.widen"} if family == "dpt" else set())
    assert {name: found[name] for name in exact} == dict.fromkeys(exact, "float32")
    norms = {name: kind for name, kind in found.items() if name.endswith("norm")}
    assert len(norms) > 10 and set(norms.values()) == {"kept"}
    assert found["decoder.layers.0.ffn.down"] == "bfloat16"


def test_a_step_asks_no_generator() -> None:
    """What does not exist need not be saved: a resumed run is the same whatever the state here."""
    state = new_state(tiny_run())
    before = torch.get_rng_state(), np.random.get_state(legacy=True)[1].copy()  # type: ignore[index] # noqa: NPY002
    step(state, [make_batch(scenes(2))])
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state(legacy=True)[1], before[1])  # type: ignore[index] # noqa: NPY002


def test_the_report_says_how_bright_the_pictures_are() -> None:
    batch = make_batch(scenes(2))
    state = new_state(tiny_run())
    report = step(state, [batch])
    mean = batch.target_BVRR3.mean().item()
    assert report.l1 == report.loss == pytest.approx(mean, rel=1e-4), "a black start"
    assert report.brightness == 0
    with torch.no_grad():
        last = state.model.decoder.head.last
        last.load_state_dict(
            {"weight": torch.zeros_like(last.weight), "bias": torch.full((192,), mean / 2)}
        )
    assert step(state, [batch]).brightness == pytest.approx(0.5, rel=1e-4)  # float32 sums


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


def test_a_fresh_network_learns_eight_pictures() -> None:
    """A zero start with the loss behind the ELU stays black; ours must leave black at once.

    Four scenes of two views each, over and over: the pictures must become better than the best
    fixed one, which is their median.
    """
    state = new_state(tiny_run())
    drawn = scenes(4)
    targets = torch.cat([scene.target_VRR3 for scene in drawn])
    median_error = (targets - targets.median(dim=0).values).abs().mean().item()
    reports = [step(state, bucket_scenes(drawn, cost, 16), grad_clip=1.0) for _ in range(100)]
    assert reports[0].loss == pytest.approx(targets.mean().item(), rel=1e-4)  # a black start
    assert reports[-1].loss < 0.7 * median_error  # measured: 0.59
    assert min(report.grad_norm for report in reports) > 0.01


@pytest.mark.slow("training")
def test_the_large_network_takes_steps() -> None:
    """All 483 M parameters, on a processor: one scene, one window of 64 pixels, 8 GB of memory."""
    changes = {"resolution": 64, "precision": "float32", "loss.perceptual": "ms_ssim"}
    settings = changed_run("paper-pretrain-large", changes)
    state = new_state(settings)
    assert count_parameters(state.model) > 480e6
    batch = make_batch([training_scene(toy_sample(0, resolution=64), 64)])
    before = state.model.decoder.rays.weight.detach().clone()
    stepped = stepper(state, settings)
    reports = [stepped.step([batch], 1e-5) for _ in range(2)]
    assert all(report.applied for report in reports)
    assert reports[1].loss < reports[0].loss
    assert not torch.equal(state.model.decoder.rays.weight, before)
