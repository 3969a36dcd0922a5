"""Laws of what moves the weights, of its rate, and of the work that a step is.

AdamW is torch's own, and Muon's steps are near orthogonal: the iteration by singular values, also
in float32. A rate rises once and falls once; its constant part knows nothing of the end. The
formula of the work agrees with torch's counter.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from model.config import BaseWidths
from model.costs import Workload, training_flops
from model.renderformer import RenderFormer
from model.width_scales import width_scales
from tests.for_each import for_each
from tests.train.kit import TINY_MODEL, tiny_run
from tests.train.toy import toy_sample
from train.data.buckets import collate_batch
from train.data.scenes import TrainingScene, training_scene
from train.loop import optimizer as muon_file
from train.loop.distributed import DistributedContext
from train.loop.optimizer import (
    Optimizer,
    StackedMuon,
    choose_muon_precision,
    orthogonal,
    split_over_ranks,
)
from train.loop.train_state import new_state
from train.settings import Precision, TrainSettings, decay_start_step, learning_rate

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


def moved(model: RenderFormer, optimizer: Optimizer) -> dict[str, torch.Tensor]:
    """Return how far every weight moved in one step."""
    before = {name: weight.detach().clone() for name, weight in model.named_parameters()}
    optimizer.step(RATE)
    return {name: weight.detach() - before[name] for name, weight in model.named_parameters()}


def test_without_muon_it_is_torchs_adamw() -> None:
    model, twin = with_gradients(), with_gradients()
    settings = tiny_run(weight_decay=0.1)
    optimizer = Optimizer(model, settings, "float32")
    assert optimizer.muon_precision is None
    adamw = torch.optim.AdamW(twin.parameters(), betas=settings.betas, weight_decay=0.1)
    for rate in (RATE, 3 * RATE):
        optimizer.step(rate)
        adamw.param_groups[0]["lr"] = rate
        adamw.step()
    for ours, theirs in zip(model.parameters(), twin.parameters(), strict=True):
        assert torch.equal(ours, theirs)


@each_kind
def test_steps_and_not_decay_follow_the_width(muon_rate: float, precision: Precision) -> None:
    """The same step times the factor of each weight; what it forgets is the same share."""

    def steps(base: BaseWidths, decay: float) -> dict[str, torch.Tensor]:
        model = with_gradients()
        run = tiny_run(muon_rate=muon_rate, weight_decay=decay, base_widths=base)
        return moved(model, Optimizer(model, run, precision))

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
    steps = moved(
        model, Optimizer(model, tiny_run(weight_decay=0.5, decayed="matrices"), "float32")
    )
    still = {name for name, step in steps.items() if not step.any()}
    weights = dict(model.named_parameters())
    vectors = {name for name, weight in weights.items() if weight.ndim == 1 and weight.any()}
    assert "encoder.registers_NW" in still and vectors <= still
    matrices = [name for name in weights if name.endswith("qkv.weight")]
    assert matrices and still.isdisjoint(matrices)


def test_muon_leaves_inputs_tokens_and_the_head_and_takes_queries_keys_and_values_apart() -> None:
    model, twin = with_gradients(), with_gradients()
    settings = tiny_run(muon_rate=3.0, weight_decay=0, muon_takes="hidden")
    without = moved(twin, Optimizer(twin, tiny_run(weight_decay=0), "float32"))
    steps = moved(model, Optimizer(model, settings, "float32"))
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


def rates(settings: TrainSettings) -> list[float]:
    return [learning_rate(step, settings) for step in range(settings.num_steps)]


def test_a_cosine_and_a_wsd_rate_rise_once_and_fall_at_the_end() -> None:
    settings = tiny_run(num_steps=100, warmup_steps=10, final_rate_share=0.1)
    found = rates(settings)
    assert 0 < found[0] < found[9] < settings.learning_rate
    assert found[10] == settings.learning_rate
    assert found[99] == pytest.approx(0.1 * settings.learning_rate)
    assert found[:11] == sorted(set(found[:11]))
    assert found[10:] == sorted(set(found[10:]), reverse=True)
    assert learning_rate(500, settings) == found[99], "no restart after the end"
    assert decay_start_step(settings) is None
    settings = tiny_run(schedule="wsd", num_steps=100, warmup_steps=10, final_rate_share=0.1)
    found, peak = rates(settings), settings.learning_rate
    assert decay_start_step(settings) == 80
    assert found[:10] == [peak * (step + 1) / 11 for step in range(10)]
    assert found[10:81] == [peak] * 71
    for step in range(80, 100):
        fallen = 0.1 + 0.9 * (1 - math.sqrt((step - 80) / 19))
        assert found[step] == pytest.approx(fallen * peak)
    assert found[99] == pytest.approx(0.1 * peak)
    assert learning_rate(500, settings) == found[99], "no restart after the end"


def test_the_decay_waits_for_the_warm_up() -> None:
    whole = tiny_run(schedule="wsd", num_steps=60, warmup_steps=50, decay_share=1.0)
    assert decay_start_step(whole) == 50
    assert rates(whole)[50] == whole.learning_rate > rates(whole)[51]
    last = tiny_run(schedule="wsd", num_steps=3, warmup_steps=2, decay_share=0.01)
    assert decay_start_step(last) == 3 and rates(last)[2] == last.learning_rate


RESOLUTION = 16
DEEPER = dataclasses.replace(TINY_MODEL, encoder_layers=2, decoder_layers=2)


def with_triangles(count: int) -> TrainingScene:
    scene = training_scene(toy_sample(0), RESOLUTION)
    old = scene.tensors
    rows = torch.arange(count) % old.num_triangles
    tensors = dataclasses.replace(
        old,
        triangles_T33=old.triangles_T33[rows],
        normals_T33=old.normals_T33[rows],
        material_TM=old.material_TM[rows],
    )
    return dataclasses.replace(scene, tensors=tensors)


@for_each("boxes", [1, 5])
def test_the_formula_says_what_any_scene_needs(boxes: int) -> None:
    """By a real forward and backward pass; the plain attention is the one that counts all."""
    batch = collate_batch([with_triangles(12 * boxes)])
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        RenderFormer(DEEPER)(batch.scenes, RESOLUTION).sum().backward()
    workload = Workload(triangles=12 * boxes, views=2, resolution=RESOLUTION)
    # a first layer needs no gradient of its inputs, which our factor of 3 counts: below 10 %
    expected = pytest.approx(int(counter.get_total_flops()), rel=0.1)
    assert training_flops(DEEPER, workload) == expected


JORDAN = (3.4445, -4.7750, 2.0315)
SHAPES = [(24, 8), (24, 8), (8, 24), (12, 12), (12, 12), (12, 12), (1, 9), (9, 1), (1, 1)]
"""Tall, wide and square ones, rows and columns; several and single ones of a shape."""
CPU = torch.device("cpu")

GAIN = JORDAN[0] ** 5
"""Five iterations lengthen what is short 485 times, a rounding of their first included."""


def matrices(seed: int, rarest: float) -> list[Tensor]:
    """Return one of each shape, the rarest direction `rarest` times as long as the longest."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for shape in SHAPES:
        u, s, vt = torch.linalg.svd(torch.randn(shape, generator=generator), full_matrices=False)
        found.append(u @ torch.diag(torch.logspace(0, float(np.log10(rarest)), len(s))) @ vt)
    return found


def exact_orthogonal(matrix: NDArray) -> NDArray:
    """Return the slow and obvious one, float64: the polynomial of every singular value."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    a, b, c = JORDAN
    s = s / max(np.sqrt((s**2).sum()), 1e-7)
    for _ in range(5):
        s = a * s + b * s**3 + c * s**5
    return (u * s) @ vt


def exactly_moved(
    weight: NDArray, gradients: Sequence[NDArray], rate: float, decay: float
) -> NDArray:
    """Return where Muon takes a weight, float64 (Jordan et al. 2024, Liu et al. 2025)."""
    mean = np.zeros_like(weight)
    for gradient in gradients:
        mean = 0.95 * mean + 0.05 * gradient
        step = exact_orthogonal(0.05 * gradient + 0.95 * mean)
        weight = (1 - rate * decay) * weight - rate * 0.2 * max(weight.shape) ** 0.5 * step
    return weight


def muon(weights: Sequence[Tensor], decay: float, precision: Precision) -> StackedMuon:
    return StackedMuon([{"params": list(weights), "weight_decay": decay}], precision)


def take_steps(
    weights: Sequence[Tensor], gradients: Sequence[Sequence[Tensor]], optimizer: torch.optim.Muon
) -> None:
    for given in gradients:
        for weight, gradient in zip(weights, given, strict=True):
            weight.grad = gradient.clone()
        optimizer.step()


@for_each("length", [0.0, 1e-30, 1e-9, 1e25])
def test_no_length_of_a_matrix_breaks_it(length: float) -> None:
    """What is shorter than 1e-7 stays short; squares may underflow or overflow, to a step of 0."""
    matrix = length * torch.randn(12, 8, generator=torch.Generator().manual_seed(0))
    (found,) = orthogonal(matrix[None], JORDAN, 5, 1e-7)
    assert torch.isfinite(found).all()
    assert found.norm() <= 1.01 * GAIN * matrix.double().norm() / 1e-7
    if not length:
        assert not found.any()


def test_several_steps_are_those_of_the_slow_twin() -> None:
    weights, gradients = matrices(0, 0.1), [matrices(seed, 0.1) for seed in (1, 2, 3)]
    expected = [
        exactly_moved(
            weight.double().numpy(), [given[index].double().numpy() for given in gradients], 0.01, 5
        )
        for index, weight in enumerate(weights)
    ]
    optimizer = muon(weights, 5, "float32")
    optimizer.param_groups[0]["lr"] = 0.01
    take_steps(weights, gradients, optimizer)
    for weight, exact in zip(weights, expected, strict=True):
        # three steps of 0.01 * 0.2 * 24 ** 0.5 at most, each as exact as above
        np.testing.assert_allclose(weight, exact, rtol=1e-6, atol=3 * 0.01 * 3 * GAIN * 2**-24)


def test_it_is_torchs_own_up_to_bfloat16() -> None:
    ours, stacked, theirs, before = (matrices(0, 0.1) for _ in range(4))
    gradients = [matrices(seed, 0.3) for seed in (1, 2, 3)]
    take_steps(ours, gradients, muon(ours, 0.5, "float32"))
    take_steps(stacked, gradients, muon(stacked, 0.5, "bfloat16"))
    plain = torch.optim.Muon(theirs, weight_decay=0.5, adjust_lr_fn="match_rms_adamw")
    take_steps(theirs, gradients, plain)
    for our, near, their, old in zip(ours, stacked, theirs, before, strict=True):
        # bfloat16 rounds to 2^-9 of a number. A third as long as the longest, and divided by the
        # length of all, directions begin at 0.1 or more and are lengthened at most 12 times; some
        # of the ten roundings that follow add to it, and cancel over the elements of a matrix
        most = 12 * 2**-9 * (their - old).norm()
        assert (our - their).norm() <= most and (near - their).norm() <= most
        assert not torch.equal(our, their) or our.numel() == 1


def test_matrices_of_a_stack_do_not_meet() -> None:
    """And one without a gradient stays where it is, and is not remembered."""
    together, alone = matrices(0, 0.1), matrices(0, 0.1)
    gradients = matrices(1, 0.1)
    take_steps(together, [gradients], muon(together, 0.5, "float32"))
    for index, weight in enumerate(alone):
        take_steps([weight], [[gradients[index]]], muon([weight], 0.5, "float32"))
        # a library may sum in another order for another size of stack
        torch.testing.assert_close(weight, together[index], rtol=1e-6, atol=1e-7)
    spared, optimizer = alone[0].clone(), muon(alone, 0.5, "float32")
    alone[0].grad = None
    optimizer.step()
    assert torch.equal(alone[0], spared) and alone[0] not in optimizer.state
    assert not torch.equal(alone[1], together[1]) and alone[1] in optimizer.state


@dataclass(frozen=True, kw_only=True)
class MixedCrew(DistributedContext):
    """Two processes, of which the other is on a processor without bfloat16."""

    def any(self, flag: bool) -> bool:
        return True


def test_the_precision_is_what_all_processors_are_quick_at(monkeypatch: pytest.MonkeyPatch) -> None:
    def chosen(crew: DistributedContext, *, quick: bool) -> str:
        monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: quick)
        return choose_muon_precision(crew)

    assert chosen(DistributedContext(device=CPU), quick=True) == "bfloat16"
    assert chosen(DistributedContext(device=CPU), quick=False) == "float32"
    assert chosen(DistributedContext(device=torch.device("cuda", 0)), quick=False) == "bfloat16"
    assert chosen(MixedCrew(device=CPU), quick=True) == "float32"


def test_the_processor_answers() -> None:
    """torch is asked by a name that it may change; Linux knows too."""
    try:
        with open("/proc/cpuinfo") as stream:
            flags = stream.read().split()
    except OSError:
        pytest.skip("no /proc/cpuinfo here")
    assert choose_muon_precision(DistributedContext(device=CPU)) == (
        "bfloat16" if "avx512_bf16" in flags else "float32"
    )


@for_each("processes", [2, 3])
def test_processes_that_share_the_work_move_alike(
    processes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each does its part of a stack, also where there are fewer matrices than processes."""
    stack = torch.randn(4, 6, 5, generator=torch.Generator().manual_seed(0))
    told: dict[int, Tensor] = {}
    monkeypatch.setattr(muon_file.dist, "is_initialized", lambda: True)
    monkeypatch.setattr(muon_file.dist, "get_world_size", lambda: processes)
    for several in (stack, stack[:1]):

        def work(some: Sequence[Tensor]) -> Tensor:
            return orthogonal(torch.stack(list(some)), JORDAN, 5, 1e-7)

        def gather(parts: list[Tensor], done: Tensor, rank: int = 0) -> None:
            told[rank] = done
            for number, part in enumerate(parts):
                part.copy_(told.get(number, torch.zeros(1)).expand_as(part))

        for rank in range(processes):
            monkeypatch.setattr(muon_file.dist, "get_rank", lambda rank=rank: rank)
            monkeypatch.setattr(
                muon_file.dist, "all_gather", lambda p, d, rank=rank: gather(p, d, rank)
            )
            found = split_over_ranks(list(several), work, torch.float32)
        assert torch.equal(found, work(list(several))), "the last to be asked was told everything"
        told.clear()
