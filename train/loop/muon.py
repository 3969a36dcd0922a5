"""Muon by stacks of matrices, over all processes; and which products a processor is quick at."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from train.loop.crew import Crew
from train.loop.decision import Decision, decides_late, move_along, move_towards
from train.settings import Precision


def fitting_precision(crew: Crew) -> Precision:
    """Return the precision of Muon's products that all processes of a crew are quick at.

    bfloat16 on a card and where the processor has AVX512_BF16, as all with AMX do. Elsewhere such a
    product is emulated: with AVX2 alone a step takes 12 times as long as in float32
    (study S83). torch's own question, `_is_mkldnn_bf16_supported`, also says yes
    where AVX-512 emulates it. One answer for all, since every process moves its copy of the weights
    itself, and copies must not drift apart. All processes must call it.
    """
    quick = crew.device.type != "cpu" or torch.cpu._is_avx512_bf16_supported()
    return "float32" if crew.any(not quick) else "bfloat16"


def muon(
    matrices: Sequence[Tensor] | Sequence[dict[str, Any]],
    weight_decay: float,
    precision: Precision,
    thirds: Sequence[Tensor] = (),
) -> torch.optim.Muon:
    """Return the optimizer of matrices [M, N].

    Args:
        matrices: what it moves, or groups of that as torch's optimizers take them, each with its
            own decay.
        weight_decay: of those without their own.
        precision: of its products. With bfloat16 on a processor it is torch's own.
        thirds: those of them that are three matrices, one above the other.
    """
    if precision == "bfloat16" and not thirds and not decides_late(_device(matrices[0])):
        return torch.optim.Muon(matrices, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")
    return StackedMuon(matrices, weight_decay, PRODUCTS[precision], thirds)


def _device(first: Tensor | dict[str, Any]) -> torch.device:
    weight: Tensor = first if isinstance(first, Tensor) else first["params"][0]
    return weight.device


PRODUCTS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""Types of the products, by precision."""


class StackedMuon(torch.optim.Muon):
    """torch's Muon with the matrices of one shape in one product, shared out over the processes.

    Settings, state and update are those of torch.optim.Muon with `match_rms_adamw`; what differs is
    rounding. Stacks cost memory for a moment: five times that of all the matrices of one shape.
    Each process orthogonalises its part of a stack and is told the others', so a matrix is moved by
    the same numbers everywhere. Momentum is kept by all of them.
    """

    decision: Decision | None = None
    """Whether the next step is taken; None: it is."""

    def __init__(
        self,
        matrices: Sequence[Tensor] | Sequence[dict[str, Any]],
        weight_decay: float,
        products: torch.dtype,
        thirds: Sequence[Tensor],
    ) -> None:
        """Take what `muon` takes."""
        super().__init__(matrices, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")
        self._products = products
        cut = {id(weight) for weight in thirds}
        self._thirds = [
            [id(weight) in cut for weight in group["params"]] for group in self.param_groups
        ]

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs; torch's optimisers keep their own fields alone."""
        own = {"_products": self._products, "_thirds": self._thirds, "decision": self.decision}
        return super().__getstate__() | own

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move every matrix along the gradient it holds; one without a gradient stays."""
        for group, thirds in zip(self.param_groups, self._thirds, strict=True):
            given = zip(group["params"], thirds, strict=True)
            held = [(weight, 3 if cut else 1) for weight, cut in given if weight.grad is not None]
            moved = [weight for weight, _ in held]
            by_shape = defaultdict[torch.Size, list[tuple[Tensor, Tensor]]](list)
            wanted_steps = self._wanted(moved, group["momentum"])
            for (weight, parts), wanted in zip(held, wanted_steps, strict=True):
                for pair in zip(weight.chunk(parts), wanted.chunk(parts), strict=True):
                    by_shape[pair[0].shape].append(pair)
            for pairs in by_shape.values():
                self._move([w for w, _ in pairs], [wanted for _, wanted in pairs], group)

    def _move(self, weights: list[Tensor], wanted: list[Tensor], group: Mapping[str, Any]) -> None:
        """Move matrices of one shape [M, N]."""
        constants = group["ns_coefficients"], group["ns_steps"], group["eps"]

        def steps(some: Sequence[Tensor]) -> Tensor:
            return orthogonal(_stacked(some, self._products), *constants)

        steps_SMN = shared_out(wanted, steps, self._products)
        # Liu et al. 2025: as long as a typical step of AdamW, whatever the shape
        rate = group["lr"] * 0.2 * math.sqrt(max(weights[0].shape))
        steps_SMN = steps_SMN.to(weights[0].dtype, memory_format=torch.contiguous_format)
        decay = group["lr"] * group["weight_decay"]
        move_along(weights, list(steps_SMN), rate, decay, self.decision)

    def _wanted(self, weights: Sequence[Tensor], momentum: float) -> Sequence[Tensor]:
        """Return the gradients [M, N] with Nesterov's momentum, and remember it."""
        if not weights:
            return []
        gradients: list[Tensor] = []
        for weight in weights:
            assert weight.grad is not None
            gradients.append(weight.grad)
            if "momentum_buffer" not in self.state[weight]:
                self.state[weight]["momentum_buffer"] = torch.zeros_like(weight.grad)
        means: list[Tensor] = [self.state[weight]["momentum_buffer"] for weight in weights]
        move_towards(means, gradients, 1 - momentum, self.decision)
        return torch._foreach_lerp(gradients, means, momentum)


def _stacked(matrices: Sequence[Tensor], kind: torch.dtype) -> Tensor:
    """Return [S, M, N] of a type: all are rounded on their way, and read once."""
    stack_SMN = matrices[0].new_empty((len(matrices), *matrices[0].shape), dtype=kind)
    torch._foreach_copy_(list(stack_SMN), list(matrices))
    return stack_SMN


def shared_out(
    matrices: Sequence[Tensor], work: Callable[[Sequence[Tensor]], Tensor], kind: torch.dtype
) -> Tensor:
    """Return work(matrices) [S, M, N], each process doing its part and receiving the others'.

    All processes must call it with matrices of the same shapes; the result is alike on each.
    """
    processes = dist.get_world_size() if dist.is_initialized() else 1
    if processes == 1:
        return work(matrices)
    each = -(-len(matrices) // processes)
    first = dist.get_rank() * each
    mine = matrices[first : first + each]
    done_EMN = matrices[0].new_zeros((each, *matrices[0].shape), dtype=kind)
    if mine:
        done_EMN[: len(mine)] = work(mine)
    parts = [torch.empty_like(done_EMN) for _ in range(processes)]
    dist.all_gather(parts, done_EMN)
    return torch.cat(parts)[: len(matrices)]


def orthogonal(
    matrices_SMN: Tensor, coefficients: tuple[float, float, float], steps: int, eps: float
) -> Tensor:
    """Return matrices [S, M, N] with the same directions, and singular values about 1.

    Each of the `steps` turns every singular value s, of a matrix of length 1, into
    a s + b s^3 + c s^5 (Newton and Schulz's iteration with Jordan's coefficients, Jordan et al.
    2024). A matrix shorter than `eps` stays short, so zeros stay zeros.
    """
    a, b, c = coefficients
    tall = matrices_SMN.shape[1] > matrices_SMN.shape[2]
    x = matrices_SMN.mT if tall else matrices_SMN  # the smaller side makes the smaller product
    x = x / torch.linalg.matrix_norm(x, keepdim=True).clamp(min=eps)
    for _ in range(steps):
        square = x @ x.mT
        polynomial = torch.baddbmm(square, square, square, beta=b, alpha=c)
        x = torch.baddbmm(x, polynomial, x, beta=a)
    return x.mT if tall else x
