"""Rounding of a layer's weights in one kernel, for training in mixed precision (bfloat16).

Autocast rounds every matrix in a separate kernel, and its gradient in another one: hundreds of
launches with little work. Here a layer's weights are rounded together. Every number is exactly that
of autocast.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call


def rounded_call(module: nn.Module, weights: dict[str, Tensor], *inputs: Any) -> Any:
    """Return module(*inputs) with some of its weights replaced by name."""
    if not weights:
        return module(*inputs)
    return functional_call(module, weights, inputs)


def rounded_weights(module: nn.Module, device: torch.device) -> dict[str, Tensor]:
    """Return a module's matrices rounded as by autocast; empty without autocast."""
    return _round_weights(
        device, ((name, w) for name, w in module.named_parameters() if w.ndim > 1)
    )


def rounded_parts_of(
    module: nn.Module, parts: Iterable[nn.Module], device: torch.device
) -> dict[str, Tensor]:
    """Return all weights of some submodules rounded as by autocast, by their names in `module`."""
    inside = {id(weight) for part in parts for weight in part.parameters()}
    named = module.named_parameters()
    return _round_weights(
        device, ((name, weight) for name, weight in named if id(weight) in inside)
    )


def _round_weights(device: torch.device, named: Iterable[tuple[str, Tensor]]) -> dict[str, Tensor]:
    kind = device.type
    if kind == "meta" or not torch.is_autocast_enabled(kind):
        return {}
    to = torch.get_autocast_dtype(kind)
    rounded = {name: weight for name, weight in named if weight.dtype == torch.float32}
    if not rounded:
        return {}
    return dict(zip(rounded, _RoundTogether.apply(to, *rounded.values()), strict=True))


class _RoundTogether(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, to: torch.dtype, *weights: Tensor) -> tuple[Tensor, ...]:
        return _copy_as(weights, to)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_copy_as(grads, torch.float32)


def _copy_as(tensors: Iterable[Tensor], to: torch.dtype) -> tuple[Tensor, ...]:
    sources = list(tensors)
    copies = [torch.empty_like(tensor, dtype=to) for tensor in sources]
    torch._foreach_copy_(copies, sources)
    return tuple(copies)
