"""Optimizers of a run: AdamW, and Muon for the matrices; and whether a step is applied at all.

The learning rate and its warm-up (warmup) are in train.settings. Muon works on stacks of equal
matrices, split over all processes.

A step whose loss or gradient is not finite must change nothing. On a CPU the host checks this at
once. On a GPU the flag stays on the device, so that the host need not wait, and the updating
kernels read it: fused AdamW, and fused SGD for all other updates. A kernel that skips writes
nothing, so that no number of a gradient that is not finite reaches the weights.
"""

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from model.precision import PRECISIONS
from model.renderformer import RenderFormer
from model.width_scales import WidthScale, width_scales
from train.loop.distributed import DistributedContext
from train.settings import Precision, TrainSettings

Updates = int | Tensor
"""Number of applied updates: int on the host, or float64 [] on a device."""


def defers_sync(device: torch.device) -> bool:
    """Return whether the host reads a step's statistics later, as on a GPU."""
    return device.type == "cuda"


def move_towards(
    tensors: Sequence[Tensor],
    goals: Sequence[Tensor],
    fraction: float | Tensor,
    skip: Tensor | None = None,
) -> None:
    """Interpolate each tensor towards its goal, in place.

    Args:
        tensors: updated in place.
        goals: tensors of the same shapes.
        fraction: from 0 to 1; float32 [] if only the device knows it.
        skip: flag that fused kernels read, float32 []: 1 if they must write nothing; None if the
            host has read it, and the step is applied.
    """
    if skip is None:
        assert not isinstance(fraction, Tensor), "only deferred kernels read it from a device"
        torch._foreach_lerp_(list(tensors), list(goals), fraction)
    else:  # x + share (goal - x)
        _run_fused_sgd(tensors, goals, rate=-fraction, decay=-1.0, skip=skip)


def move_along(
    weights: Sequence[Tensor],
    steps: Sequence[Tensor],
    rate: float,
    decay: float,
    skip: Tensor | None = None,
) -> None:
    """Decay each weight and subtract `rate` times its step, in place.

    Args:
        weights: updated in place.
        steps: tensors of the same shapes and types.
        rate: above 0.
        decay: fraction from 0 to 1.
        skip: as in `move_towards`.
    """
    if skip is None:
        torch._foreach_mul_(list(weights), 1 - decay)
        torch._foreach_add_(list(weights), list(steps), alpha=-rate)
    else:  # w - rate (step + decay / rate w), which reads and writes each weight once
        _run_fused_sgd(weights, steps, rate=rate, decay=decay / rate, skip=skip)


def _run_fused_sgd(
    tensors: Sequence[Tensor],
    operands: Sequence[Tensor],
    *,
    rate: float | Tensor,
    decay: float,
    skip: Tensor,
) -> None:
    """Subtract rate * (operand + decay * tensor) from each tensor, unless the step is skipped."""
    torch._fused_sgd_(
        list(tensors),
        [_with_strides_of(tensor, other) for tensor, other in zip(tensors, operands, strict=True)],
        [],
        weight_decay=decay,
        lr=rate,
        found_inf=skip,
        momentum=0.0, dampening=0.0, nesterov=False, maximize=False, is_first_step=False,
    )  # fmt: skip


def _with_strides_of(tensor: Tensor, other: Tensor) -> Tensor:
    """Return `other` with the strides of `tensor`, which the kernel assumes."""
    if other.stride() == tensor.stride():
        return other
    return torch.empty_like(tensor).copy_(other)


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


class StackedMuon(torch.optim.Muon):
    """torch's Muon with matrices of one shape in one product, split over the processes.

    Settings, state and update are those of torch.optim.Muon with `match_rms_adamw`, up to rounding.
    Stacks briefly cost memory: five times that of all the matrices of one shape. Each process
    orthogonalizes its slice of a stack and gathers the others', so that every process applies the
    same update. All processes keep the momentum.
    """

    found_inf: Tensor | None = None
    """Flag of the next step by torch's name for it, as `skip` of `move_towards`."""

    def __init__(
        self,
        groups: Sequence[dict[str, Any]],
        precision: Precision,
        thirds: Sequence[Tensor] = (),
    ) -> None:
        """Create the optimizer of matrices [M, N].

        Args:
            groups: parameter groups as torch's optimizers take them, each with its decay.
            precision: precision of its products.
            thirds: those of the weights that are three stacked matrices.
        """
        super().__init__(groups, adjust_lr_fn="match_rms_adamw")
        self._products = PRECISIONS[precision].dtype
        self._thirds = set(thirds)

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update every matrix that has a gradient."""
        for group in self.param_groups:
            moved = [weight for weight in group["params"] if weight.grad is not None]
            by_shape = defaultdict[torch.Size, list[tuple[Tensor, Tensor]]](list)
            directions = self._momentum_directions(moved, group["momentum"])
            for weight, direction in zip(moved, directions, strict=True):
                parts = 3 if weight in self._thirds else 1
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
            stack_SMN = some[0].new_empty((len(some), *some[0].shape), dtype=self._products)
            torch._foreach_copy_(list(stack_SMN), list(some))  # stacks and casts in one pass
            return orthogonal(stack_SMN, *constants)

        steps_SMN = split_over_ranks(directions, steps, self._products)
        # Liu et al. 2025: as long as a typical step of AdamW, whatever the shape
        rate = group["lr"] * 0.2 * math.sqrt(max(weights[0].shape))
        steps_SMN = steps_SMN.to(weights[0].dtype, memory_format=torch.contiguous_format)
        decay = group["lr"] * group["weight_decay"]
        move_along(weights, list(steps_SMN), rate, decay, self.found_inf)

    def _momentum_directions(self, weights: Sequence[Tensor], momentum: float) -> Sequence[Tensor]:
        """Update the momentum, and return the gradients [M, N] with Nesterov's momentum."""
        if not weights:
            return []
        gradients = [weight.grad for weight in weights if weight.grad is not None]
        for weight, gradient in zip(weights, gradients, strict=True):
            if "momentum_buffer" not in self.state[weight]:
                self.state[weight]["momentum_buffer"] = torch.zeros_like(gradient)
        means: list[Tensor] = [self.state[weight]["momentum_buffer"] for weight in weights]
        move_towards(means, gradients, 1 - momentum, self.found_inf)
        return torch._foreach_lerp(gradients, means, momentum)


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


_KEPT: dict[type, tuple[str, ...]] = {
    torch.optim.AdamW: ("exp_avg", "exp_avg_sq"),
    StackedMuon: ("momentum_buffer",),
}
"""Names of the state tensors for each weight, without AdamW's count of updates."""

_SCALE = "width_scale"
"""Key of an optimizer's parameter group that holds the factor of its rate."""


class Optimizer:
    """Updates the weights of a network with AdamW, and the matrices with Muon if configured.

    Muon (Jordan et al. 2024) makes the step of a matrix nearly orthogonal, so that its rare
    directions move as far as the frequent ones. Its steps are scaled to the size of AdamW's (Liu et
    al. 2025), so that one learning rate serves both.

    Gradients that are summed in another order differ by about 1e-7 of themselves. With Muon's
    products in float32 this changes a weight's step by up to 1e-5 of a typical step; with products
    in bfloat16, where such a difference can cross a rounding, by up to a tenth.
    """

    muon_precision: Precision | None
    """Precision of Muon's products; None if AdamW updates every weight."""

    def __init__(self, model: RenderFormer, settings: TrainSettings, precision: Precision) -> None:
        """Create the optimizers; `precision` is that of Muon's products."""
        device = next(model.parameters()).device
        self._names: dict[Tensor, str] = {weight: name for name, weight in model.named_parameters()}
        muon, adamw = _groups(self._names, width_scales(model, settings.base_widths), settings)
        fused = True if defers_sync(device) else None
        self._optimizers: list[tuple[torch.optim.Optimizer, float]] = [
            (torch.optim.AdamW(adamw, betas=settings.betas, fused=fused), 1.0)
        ]
        self.muon_precision = precision if muon else None
        if muon:
            by_thirds = settings.muon_takes == "hidden"
            thirds = [w for w, name in self._names.items() if by_thirds and name.endswith(_QKV)]
            self._optimizers.append((StackedMuon(muon, precision, thirds), settings.muon_rate))

    def zero_grad(self) -> None:
        """Clear the gradients."""
        for optimizer, _ in self._optimizers:
            optimizer.zero_grad(set_to_none=True)

    def step(self, learning_rate: float, skip: Tensor | None = None) -> None:
        """Update every weight by its gradient; `skip` as in `move_towards`."""
        for optimizer, factor in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate * factor * group[_SCALE]
            optimizer.found_inf = skip  # type: ignore[attr-defined]
            optimizer.step()

    def optimizer_state(self) -> dict[str, Tensor]:
        """Return the state tensors by `kind/weight`; empty before the first update."""
        return {
            f"{kind}/{self._names[weight]}": memory[kind]
            for optimizer, _ in self._optimizers
            for weight, memory in optimizer.state.items()
            for kind in _KEPT[type(optimizer)]
        }

    def load_optimizer_state(self, tensors: Mapping[str, Tensor], updates: int) -> None:
        """Restore the state tensors, saved after `updates` updates (1 or more)."""
        for optimizer, _ in self._optimizers:
            for weight in itertools.chain(*(group["params"] for group in optimizer.param_groups)):
                name = self._names[weight]
                state = {
                    kind: tensors[f"{kind}/{name}"].to(weight.device, copy=True)
                    for kind in _KEPT[type(optimizer)]
                }
                if isinstance(optimizer, torch.optim.AdamW):
                    fused = optimizer.defaults["fused"]  # it counts on the GPU
                    state["step"] = torch.tensor(
                        float(updates), device=weight.device if fused else None
                    )
                optimizer.state[weight] = state


def _groups(
    names: Mapping[Tensor, str], scales: Mapping[str, WidthScale], settings: TrainSettings
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return parameter groups of equal rate factor and equal decay, of Muon and of AdamW.

    The decay of a step is independent of the rate factor: decay that shrank with the rate would be
    too weak for wide networks (Wortsman et al. 2023).
    """
    groups = defaultdict[tuple[bool, float, float], list[Tensor]](list)
    for weight, name in names.items():
        is_taken = settings.muon_takes == "matrices" or _LAYERS in name
        by_muon = settings.muon_rate > 0 and weight.ndim == 2 and is_taken
        is_matrix = weight.ndim > 1 and not name.endswith(_TOKENS)
        decay = settings.weight_decay if settings.decayed == "all" or is_matrix else 0.0
        scale = scales[name].muon if by_muon else scales[name].adamw
        groups[by_muon, scale, decay].append(weight)
    muon, adamw = (
        [
            {"params": params, "weight_decay": decay / scale, _SCALE: scale}
            for (by_muon, scale, decay), params in groups.items()
            if by_muon == kind
        ]
        for kind in (True, False)
    )
    return muon, adamw


_TOKENS = "registers_NW"
"""Suffix of the learned tokens, which have the shape of a matrix but are vectors."""

_LAYERS = ".layers."
_QKV = ".qkv.weight"
"""Parts of weight names: all layers, and the stacked query, key and value matrices, which `hidden`
takes as separate ones, as Muon's authors do."""
