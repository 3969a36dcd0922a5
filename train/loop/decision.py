"""Decision whether a step is applied, made on the device so that the host need not wait.

A step whose loss or gradient is not finite must change nothing. On a CPU the host checks this at
once. On a GPU the flag stays on the device, and the updating kernels read it: fused AdamW, and
fused SGD for all other updates. A kernel that skips writes nothing, so that no number of a gradient
that is not finite reaches the weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

Updates = int | Tensor
"""Number of applied updates: int on the host, or float64 [] on a device."""


def defers_sync(device: torch.device) -> bool:
    """Return whether the host reads a step's statistics later, as on a GPU."""
    return device.type == "cuda"


@dataclass(frozen=True, kw_only=True, eq=False)
class Decision:
    """Decision whether one step is applied, and the number of updates before it."""

    applied: Tensor
    """bool [], True if loss and gradient are finite."""
    updates: Updates
    """Number of steps that were applied before this one."""
    defer_sync: bool
    """True if only kernels read `applied`; the host does not wait for it."""

    @property
    def is_skipped(self) -> bool:
        """True if the host knows that the step is skipped."""
        return not self.defer_sync and not bool(self.applied)

    @property
    def skip_flag(self) -> Tensor:
        """Flag of fused kernels, float32 []: 1 if they must write nothing."""
        return (~self.applied).float()


def make_decision(
    loss: Tensor, grad_norm: Tensor, updates: Updates, *, defer_sync: bool
) -> Decision:
    """Return the decision about a step from its loss [] and gradient norm []."""
    applied = torch.isfinite(loss) & torch.isfinite(grad_norm)
    return Decision(applied=applied, updates=updates, defer_sync=defer_sync)


def move_towards(
    tensors: Sequence[Tensor],
    goals: Sequence[Tensor],
    fraction: float | Tensor,
    decision: Decision | None = None,
) -> None:
    """Interpolate each tensor towards its goal, in place.

    Args:
        tensors: updated in place.
        goals: tensors of the same shapes.
        fraction: from 0 to 1; float32 [] if only the device knows it.
        decision: must not be skipped; kernels read it if its sync is deferred.
    """
    if decision is None or not decision.defer_sync:
        assert not isinstance(fraction, Tensor), "only deferred kernels read it from a device"
        torch._foreach_lerp_(list(tensors), list(goals), fraction)
    else:  # x + share (goal - x)
        _run_fused_sgd(tensors, goals, rate=-fraction, decay=-1.0, decision=decision)


def move_along(
    weights: Sequence[Tensor],
    steps: Sequence[Tensor],
    rate: float,
    decay: float,
    decision: Decision | None = None,
) -> None:
    """Decay each weight and subtract `rate` times its step, in place.

    Args:
        weights: updated in place.
        steps: tensors of the same shapes and types.
        rate: above 0.
        decay: fraction from 0 to 1.
        decision: as in `move_towards`.
    """
    if decision is None or not decision.defer_sync:
        torch._foreach_mul_(list(weights), 1 - decay)
        torch._foreach_add_(list(weights), list(steps), alpha=-rate)
    else:  # w - rate (step + decay / rate w), which reads and writes each weight once
        _run_fused_sgd(weights, steps, rate=rate, decay=decay / rate, decision=decision)


def _run_fused_sgd(
    tensors: Sequence[Tensor],
    operands: Sequence[Tensor],
    *,
    rate: float | Tensor,
    decay: float,
    decision: Decision,
) -> None:
    """Subtract rate * (operand + decay * tensor) from each tensor, unless the step is skipped."""
    off: dict[str, Any] = {
        "momentum": 0.0, "dampening": 0.0, "nesterov": False, "maximize": False,
        "is_first_step": False,
    }  # fmt: skip
    torch._fused_sgd_(
        list(tensors),
        [_with_strides_of(tensor, other) for tensor, other in zip(tensors, operands, strict=True)],
        [],
        weight_decay=decay,
        lr=rate,
        found_inf=decision.skip_flag,
        **off,
    )


def _with_strides_of(tensor: Tensor, other: Tensor) -> Tensor:
    """Return `other` with the strides of `tensor`, which the kernel assumes."""
    if other.stride() == tensor.stride():
        return other
    return torch.empty_like(tensor).copy_(other)
