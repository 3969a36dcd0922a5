"""Laws of what moves the weights: AdamW is torch's own, and Muon's steps are near orthogonal."""

import copy
import math

import pytest
import torch

from model.base_widths import BaseWidths
from model.renderformer import RenderFormer
from model.width_scales import width_scales
from tests.for_each import for_each
from tests.train.kit import tiny_run
from train.loop.muon import orthogonal
from train.loop.optim import Updater
from train.loop.state import new_state
from train.settings import Precision, TrainSettings

RATE = 1e-3
each_kind = pytest.mark.parametrize(
    ("muon_rate", "precision"), [(0.0, "bfloat16"), (3.0, "bfloat16"), (3.0, "float32")]
)
"""AdamW alone, and with Muon on each kind of processor."""

BASE = BaseWidths(width=18, head_width=18)
"""Half as wide as the network here."""


def with_gradients(seed: int = 0) -> RenderFormer:
    """Return a network whose gradients are random, the rarest direction a hundredth as long."""
    model = new_state(tiny_run()).model
    generator = torch.Generator().manual_seed(seed)
    for weight in model.parameters():
        gradient = torch.randn(weight.shape, generator=generator)
        if weight.ndim == 2 and min(weight.shape) > 1:
            u, s, vt = torch.linalg.svd(gradient, full_matrices=False)
            gradient = u @ torch.diag(torch.logspace(0, -2, len(s))) @ vt
        weight.grad = gradient
    return model


def moved(model: RenderFormer, updater: Updater) -> dict[str, torch.Tensor]:
    """Return how far every weight moved in one step."""
    before = {name: weight.detach().clone() for name, weight in model.named_parameters()}
    updater.step(RATE)
    return {name: weight.detach() - before[name] for name, weight in model.named_parameters()}


def test_without_muon_it_is_torchs_adamw() -> None:
    model = with_gradients()
    twin = copy.deepcopy(model)
    for ours, theirs in zip(model.parameters(), twin.parameters(), strict=True):
        theirs.grad = None if ours.grad is None else ours.grad.clone()
    settings = tiny_run(weight_decay=0.1)
    updater = Updater(model, settings, "float32")
    assert updater.muon_precision is None
    adamw = torch.optim.AdamW(twin.parameters(), betas=settings.betas, weight_decay=0.1)
    for rate in (RATE, 3 * RATE):
        updater.step(rate)
        adamw.param_groups[0]["lr"] = rate
        adamw.step()
    for ours, theirs in zip(model.parameters(), twin.parameters(), strict=True):
        assert torch.equal(ours, theirs)


@for_each(("precision", "beside"), [("bfloat16", 0.05), ("float32", 1e-4)])
def test_muon_moves_every_direction_of_a_matrix_about_as_far(
    precision: Precision, beside: float
) -> None:
    model = with_gradients()
    gradients = {name: weight.grad for name, weight in model.named_parameters()}
    matrices = 0
    updater = Updater(model, tiny_run(muon_rate=3.0, weight_decay=0), precision)
    for name, step in moved(model, updater).items():
        gradient = gradients[name]
        assert gradient is not None
        if step.ndim != 2 or min(step.shape) == 1:
            continue
        matrices += 1
        u, _, vt = torch.linalg.svd(gradient, full_matrices=False)
        seen = -(u.T @ step @ vt.T) / (3 * RATE * 0.2 * math.sqrt(max(step.shape)))
        lengths = seen.diagonal()
        # five of Muon's iterations take a hundredth of the length to between 0.3 and 1.2 of the
        # whole (their polynomial, by hand); what they leave beside the diagonal is rounding
        assert 0.3 < lengths.min() and lengths.max() < 1.25, name
        assert (seen - torch.diag(lengths)).abs().max() < beside, name
    assert matrices > 10


@each_kind
def test_without_a_gradient_every_weight_shrinks_by_its_rate(
    muon_rate: float, precision: Precision
) -> None:
    model = with_gradients()
    for weight in model.parameters():
        weight.grad = torch.zeros_like(weight)
    before = [weight.detach().clone() for weight in model.parameters()]
    Updater(model, tiny_run(muon_rate=muon_rate, weight_decay=0.5), precision).step(RATE)
    for ours, old in zip(model.parameters(), before, strict=True):
        # float32 rounding of one product
        rate = muon_rate * RATE if muon_rate and old.ndim == 2 else RATE
        torch.testing.assert_close(ours.detach(), (1 - 0.5 * rate) * old, rtol=1e-6, atol=0)


@for_each("precision", ["bfloat16", "float32"])
def test_with_muon_vectors_are_moved_as_without(precision: Precision) -> None:
    def moved_by(settings: TrainSettings) -> dict[str, torch.Tensor]:
        model = with_gradients()
        return moved(model, Updater(model, settings, precision))

    with_muon, without = moved_by(tiny_run(muon_rate=3.0)), moved_by(tiny_run())
    vectors = [name for name, step in without.items() if step.ndim == 1]
    assert vectors and all(torch.equal(with_muon[name], without[name]) for name in vectors)


@each_kind
def test_what_is_remembered_can_be_taken_over(muon_rate: float, precision: Precision) -> None:
    settings = tiny_run(muon_rate=muon_rate)
    model = with_gradients()
    updater = Updater(model, settings, precision)
    assert updater.memories() == {}
    updater.step(RATE)
    twin = copy.deepcopy(model)
    other = Updater(twin, settings, precision)
    other.remember(updater.memories(), 1)
    kinds = {name.split("/")[0] for name in updater.memories()}
    assert kinds == {"exp_avg", "exp_avg_sq"} | ({"momentum_buffer"} if muon_rate else set())
    for network, own in ((model, updater), (twin, other)):
        for weight, like in zip(network.parameters(), with_gradients(1).parameters(), strict=True):
            weight.grad = like.grad
        own.step(RATE)
    for ours, theirs in zip(model.parameters(), twin.parameters(), strict=True):
        assert torch.equal(ours, theirs)


@each_kind
def test_steps_and_not_decay_follow_the_width(muon_rate: float, precision: Precision) -> None:
    """The same step times the factor of each weight; what it forgets is the same share."""

    def steps(base: BaseWidths, decay: float) -> dict[str, torch.Tensor]:
        model = with_gradients()
        run = tiny_run(muon_rate=muon_rate, weight_decay=decay, base_widths=base)
        return moved(model, Updater(model, run, precision))

    plain, scaled = steps(BaseWidths(), 0.0), steps(BASE, 0.0)
    decayed = {name: step - scaled[name] for name, step in steps(BASE, 0.5).items()}
    model = with_gradients()
    scales, weights = width_scales(model, BASE), dict(model.named_parameters())
    factors = set()
    for name, step in scaled.items():
        with_muon = muon_rate and step.ndim == 2
        factor = scales[name].muon if with_muon else scales[name].adamw
        factors.add(round(factor, 6))
        torch.testing.assert_close(step, factor * plain[name], rtol=1e-3, atol=1e-7)
        forgotten = -0.5 * RATE * (muon_rate if with_muon else 1) * weights[name].detach()
        torch.testing.assert_close(decayed[name], forgotten, rtol=1e-2, atol=1e-6)
    assert len(factors) > 1


def test_what_is_said_not_to_decay_does_not() -> None:
    """Norms, biases and learned tokens, also those that come as a matrix."""
    model = with_gradients()
    for weight in model.parameters():
        weight.grad = torch.zeros_like(weight)
    steps = moved(model, Updater(model, tiny_run(weight_decay=0.5, decayed="matrices"), "float32"))
    still = {name for name, step in steps.items() if not step.any()}
    weights = dict(model.named_parameters())
    vectors = {name for name, weight in weights.items() if weight.ndim == 1 and weight.any()}
    assert "encoder.registers_NW" in still and vectors <= still
    matrices = [name for name in weights if name.endswith("qkv.weight")]
    assert matrices and still.isdisjoint(matrices)


def test_muon_leaves_inputs_tokens_and_the_head_and_takes_queries_keys_and_values_apart() -> None:
    model = with_gradients()
    settings = tiny_run(muon_rate=3.0, weight_decay=0, muon_takes="hidden")
    twin = copy.deepcopy(model)
    for ours, theirs in zip(twin.parameters(), model.parameters(), strict=True):
        assert theirs.grad is not None
        ours.grad = theirs.grad.clone()
    without = moved(twin, Updater(twin, tiny_run(weight_decay=0), "float32"))
    steps = moved(model, Updater(model, settings, "float32"))
    for name, step in steps.items():
        by_adamw = torch.equal(step, without[name])
        assert by_adamw == (".layers." not in name or step.ndim != 2), name
    name = "encoder.layers.0.attention.qkv.weight"
    gradient = dict(model.named_parameters())[name].grad
    assert gradient is not None
    for step, alone in zip(steps[name].chunk(3), gradient.chunk(3), strict=True):
        (length_one,) = orthogonal(alone[None], (3.4445, -4.7750, 2.0315), 5, 1e-7)
        wanted = -3 * RATE * 0.2 * math.sqrt(max(alone.shape)) * length_one
        torch.testing.assert_close(step, wanted, rtol=0, atol=1e-3 * RATE)
