"""Muon in float32 is Muon: the iteration by singular values, torch's own, and nothing new."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.for_each import for_each
from train.loop import muon as muon_file
from train.loop.distributed import DistributedContext
from train.loop.muon import choose_muon_precision, muon, orthogonal, split_over_ranks

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


def moved(
    weights: Sequence[Tensor], gradients: Sequence[Sequence[Tensor]], optimizer: torch.optim.Muon
) -> None:
    for given in gradients:
        for weight, gradient in zip(weights, given, strict=True):
            weight.grad = gradient.clone()
        optimizer.step()


def test_every_singular_value_follows_the_polynomial() -> None:
    for matrix in matrices(0, rarest=1e-4):
        (found,) = orthogonal(matrix[None], JORDAN, 5, 1e-7)
        expected = exact_orthogonal(matrix.double().numpy())
        # float32 rounds to 2^-24 of a number; three roundings lengthened by all five iterations
        np.testing.assert_allclose(found, expected, rtol=0, atol=3 * GAIN * 2**-24)


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
    moved(weights, gradients, optimizer)
    for weight, exact in zip(weights, expected, strict=True):
        # three steps of 0.01 * 0.2 * 24 ** 0.5 at most, each as exact as above
        np.testing.assert_allclose(weight, exact, rtol=1e-6, atol=3 * 0.01 * 3 * GAIN * 2**-24)


def test_it_is_torchs_own_up_to_bfloat16() -> None:
    ours, theirs = matrices(0, 0.1), matrices(0, 0.1)
    before, gradients = matrices(0, 0.1), [matrices(seed, 0.3) for seed in (1, 2, 3)]
    for weights, precision in ((ours, "float32"), (theirs, "bfloat16")):
        optimizer = muon(weights, 0.5, precision)  # type: ignore[arg-type]
        assert (type(optimizer) is torch.optim.Muon) == (precision == "bfloat16")
        moved(weights, gradients, optimizer)
    for our, their, old in zip(ours, theirs, before, strict=True):
        # bfloat16 rounds to 2^-9 of a number. A third as long as the longest, and divided by the
        # length of all, directions begin at 0.1 or more and are lengthened at most 12 times; some
        # of the ten roundings that follow add to it, and cancel over the elements of a matrix
        assert (our - their).norm() <= 12 * 2**-9 * (their - old).norm()
        assert not torch.equal(our, their) or our.numel() == 1


def test_matrices_of_a_stack_do_not_meet() -> None:
    """And one without a gradient stays where it is, and is not remembered."""
    together, alone = matrices(0, 0.1), matrices(0, 0.1)
    gradients = matrices(1, 0.1)
    moved(together, [gradients], muon(together, 0.5, "float32"))
    for index, weight in enumerate(alone):
        moved([weight], [[gradients[index]]], muon([weight], 0.5, "float32"))
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


def test_a_copy_moves_the_copied_weights_alike() -> None:
    """Torch's optimisers forget fields of their subclasses when they are copied."""
    weights = [torch.nn.Parameter(torch.randn(6, 4)), torch.nn.Parameter(torch.randn(4, 4))]
    first = muon(weights, 0.1, "float32", thirds=weights[:1])
    second = copy.deepcopy(first)
    copies = second.param_groups[0]["params"]
    for ours, theirs in zip(weights, copies, strict=True):
        ours.grad = torch.randn_like(ours)
        theirs.grad = ours.grad.clone()
    first.step()
    second.step()
    for ours, theirs in zip(weights, copies, strict=True):
        assert torch.equal(ours, theirs)
