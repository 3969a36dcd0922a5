"""Muon on stacks of equal matrices, split over all processes, and the precision of its products."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from train.loop.decision import Decision, defers_sync, move_along, move_towards
from train.loop.distributed import DistributedContext
from train.settings import Precision


def choose_muon_precision(dist_context: DistributedContext) -> Precision:
    """Return the fastest precision of Muon's products that all processes support.

    bfloat16 on a GPU and on CPUs with AVX512_BF16, as all with AMX have. Elsewhere such a product
    is emulated: with AVX2 alone a step takes 12 times as long as in float32 (study S83). Torch's
    own check, `_is_mkldnn_bf16_supported`, is also true where AVX-512 emulates it. The result is
    equal in all processes, since each updates its own copy of the weights, and copies must not
    drift apart. All processes must call it.
    """
    quick = dist_context.device.type != "cpu" or torch.cpu._is_avx512_bf16_supported()
    return "float32" if dist_context.any(not quick) else "bfloat16"


def muon(
    matrices: Sequence[Tensor] | Sequence[dict[str, Any]],
    weight_decay: float,
    precision: Precision,
    thirds: Sequence[Tensor] = (),
) -> torch.optim.Muon:
    """Return the Muon optimizer of matrices [M, N].

    Args:
        matrices: weights, or parameter groups as torch's optimizers take them, each with its decay.
        weight_decay: decay of weights without a group.
        precision: precision of its products. With bfloat16 on a CPU it is torch's own class.
        thirds: those of the weights that are three stacked matrices.
    """
    first = matrices[0] if isinstance(matrices[0], Tensor) else matrices[0]["params"][0]
    if precision == "bfloat16" and not thirds and not defers_sync(first.device):
        return torch.optim.Muon(matrices, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")
    return StackedMuon(matrices, weight_decay, PRODUCTS[precision], thirds)


PRODUCTS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""Types of matrix products, by precision."""


class StackedMuon(torch.optim.Muon):
    """torch's Muon with matrices of one shape in one product, split over the processes.

    Settings, state and update are those of torch.optim.Muon with `match_rms_adamw`, up to rounding.
    Stacks briefly cost memory: five times that of all the matrices of one shape. Each process
    orthogonalizes its slice of a stack and gathers the others', so that every process applies the
    same update. All processes keep the momentum.
    """

    decision: Decision | None = None
    """Decision of the next step, set by the caller; None applies it."""

    def __init__(
        self,
        matrices: Sequence[Tensor] | Sequence[dict[str, Any]],
        weight_decay: float,
        products: torch.dtype,
        thirds: Sequence[Tensor],
    ) -> None:
        """Create the optimizer; arguments as in `muon`, with `products` a type."""
        super().__init__(matrices, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")
        self._products = products
        cut = {id(weight) for weight in thirds}
        self._thirds = [
            [id(weight) in cut for weight in group["params"]] for group in self.param_groups
        ]

    def __getstate__(self) -> dict[str, Any]:
        """Return the state of a copy; torch's optimizers copy only their own fields."""
        fields = {"_products": self._products, "_thirds": self._thirds, "decision": self.decision}
        return super().__getstate__() | fields

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update every matrix that has a gradient."""
        for group, thirds in zip(self.param_groups, self._thirds, strict=True):
            weight_cuts = zip(group["params"], thirds, strict=True)
            held = [
                (weight, 3 if cut else 1) for weight, cut in weight_cuts if weight.grad is not None
            ]
            moved = [weight for weight, _ in held]
            by_shape = defaultdict[torch.Size, list[tuple[Tensor, Tensor]]](list)
            directions = self._momentum_directions(moved, group["momentum"])
            for (weight, parts), direction in zip(held, directions, strict=True):
                for pair in zip(weight.chunk(parts), direction.chunk(parts), strict=True):
                    by_shape[pair[0].shape].append(pair)
            for pairs in by_shape.values():
                self._move([w for w, _ in pairs], [direction for _, direction in pairs], group)

    def _move(
        self, weights: list[Tensor], directions: list[Tensor], group: Mapping[str, Any]
    ) -> None:
        """Update matrices of one shape [M, N]."""
        constants = group["ns_coefficients"], group["ns_steps"], group["eps"]

        def steps(some: Sequence[Tensor]) -> Tensor:
            return orthogonal(_stack(some, self._products), *constants)

        steps_SMN = split_over_ranks(directions, steps, self._products)
        # Liu et al. 2025: as long as a typical step of AdamW, whatever the shape
        rate = group["lr"] * 0.2 * math.sqrt(max(weights[0].shape))
        steps_SMN = steps_SMN.to(weights[0].dtype, memory_format=torch.contiguous_format)
        decay = group["lr"] * group["weight_decay"]
        move_along(weights, list(steps_SMN), rate, decay, self.decision)

    def _momentum_directions(self, weights: Sequence[Tensor], momentum: float) -> Sequence[Tensor]:
        """Update the momentum, and return the gradients [M, N] with Nesterov's momentum."""
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


def _stack(matrices: Sequence[Tensor], kind: torch.dtype) -> Tensor:
    """Return matrices stacked to [S, M, N] and cast to a type, in one pass."""
    stack_SMN = matrices[0].new_empty((len(matrices), *matrices[0].shape), dtype=kind)
    torch._foreach_copy_(list(stack_SMN), list(matrices))
    return stack_SMN


def split_over_ranks(
    matrices: Sequence[Tensor], work: Callable[[Sequence[Tensor]], Tensor], kind: torch.dtype
) -> Tensor:
    """Return work(matrices) [S, M, N], computed in slices by all processes.

    All processes must call it with matrices of the same shapes; the result is equal on each.
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
    """Return matrices [S, M, N] with the same singular vectors and singular values near 1.

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
