"""Whether a step moves the weights: decided where the gradient is, so that no card is waited for.

A step whose loss or gradient is not finite must change nothing. On a processor that is asked and
answered at once. On a card the answer stays there, and the kernels that would move something ask it
themselves: fused AdamW, and for all else the kernel of fused SGD, which takes it too. What they
leave alone they do not touch, so that nothing of a gradient that is not finite reaches it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

Updates = int | Tensor
"""A number of updates: of the host, or float64 [] on a device."""


def decides_late(device: torch.device) -> bool:
    """Return whether the host learns only later what a step did."""
    return device.type == "cuda"


@dataclass(frozen=True, kw_only=True, eq=False)
class Decision:
    """Whether one step is applied."""

    applied: Tensor
    """bool []."""
    updates: Updates
    """How many were applied before it."""
    is_late: bool
    """Whether only kernels ask for the answer; the host does otherwise."""

    @property
    def is_refused(self) -> bool:
        """Whether the host knows that nothing is to be moved."""
        return not self.is_late and not bool(self.applied)

    @property
    def refused(self) -> Tensor:
        """What fused kernels ask: float32 [], 1 where they must touch nothing."""
        return (~self.applied).float()


def decided(loss: Tensor, grad_norm: Tensor, updates: Updates, *, is_late: bool) -> Decision:
    """Return the decision about a step by the two figures [] that tell all."""
    applied = torch.isfinite(loss) & torch.isfinite(grad_norm)
    return Decision(applied=applied, updates=updates, is_late=is_late)


def move_towards(
    tensors: Sequence[Tensor],
    goals: Sequence[Tensor],
    share: float | Tensor,
    decision: Decision | None = None,
) -> None:
    """Move each tensor by a share (float32 [] where the device knows it) of its way to its goal.

    Args:
        tensors: are moved in place.
        goals: of the same shapes.
        share: from 0 to 1.
        decision: where it is late, its kernels ask it; it must not be refused.
    """
    if decision is None or not decision.is_late:
        assert not isinstance(share, Tensor), "only kernels that decide late take it from a device"
        torch._foreach_lerp_(list(tensors), list(goals), share)
    else:  # x + share (goal - x)
        _fused(tensors, goals, rate=-share, decay=-1.0, decision=decision)


def move_along(
    weights: Sequence[Tensor],
    steps: Sequence[Tensor],
    rate: float,
    decay: float,
    decision: Decision | None = None,
) -> None:
    """Shrink each weight by a share `decay` of it and take `rate` times its step off, in place.

    Args:
        weights: are moved in place.
        steps: of the same shapes and types.
        rate: above 0.
        decay: from 0 to 1.
        decision: as in `move_towards`.
    """
    if decision is None or not decision.is_late:
        torch._foreach_mul_(list(weights), 1 - decay)
        torch._foreach_add_(list(weights), list(steps), alpha=-rate)
    else:  # w - rate (step + decay / rate w), which reads and writes each weight once
        _fused(weights, steps, rate=rate, decay=decay / rate, decision=decision)


def _fused(
    tensors: Sequence[Tensor],
    others: Sequence[Tensor],
    *,
    rate: float | Tensor,
    decay: float,
    decision: Decision,
) -> None:
    """Take rate (other + decay tensor) off each tensor, unless it is decided otherwise."""
    off: dict[str, Any] = {
        "momentum": 0.0, "dampening": 0.0, "nesterov": False, "maximize": False,
        "is_first_step": False,
    }  # fmt: skip
    torch._fused_sgd_(
        list(tensors),
        [_laid_as(tensor, other) for tensor, other in zip(tensors, others, strict=True)],
        [],
        weight_decay=decay,
        lr=rate,
        found_inf=decision.refused,
        **off,
    )


def _laid_as(tensor: Tensor, other: Tensor) -> Tensor:
    """Return the other with the first one's strides, which the kernel takes for granted."""
    if other.stride() == tensor.stride():
        return other
    return torch.empty_like(tensor).copy_(other)
