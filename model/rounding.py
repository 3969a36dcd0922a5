"""Weights rounded once a pass, all of a layer in one kernel, where training computes in few bits.

Autocast rounds every matrix in a kernel of its own, and its gradient in another on the way back:
hundreds of launches that do next to nothing. Here a layer's are rounded together. Every number is
what it would be with autocast alone, to the bit.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call


def rounded_call(module: nn.Module, weights: dict[str, Tensor], *inputs: Any) -> Any:
    """Return module(*inputs), with some of its weights replaced by name."""
    if not weights:
        return module(*inputs)
    return functional_call(module, weights, inputs)


def rounded_weights(module: nn.Module, device: torch.device) -> dict[str, Tensor]:
    """Return a module's matrices rounded as autocast would; empty where it is off."""
    return _rounded(device, ((name, w) for name, w in module.named_parameters() if w.ndim > 1))


def rounded_parts_of(
    module: nn.Module, parts: Iterable[nn.Module], device: torch.device
) -> dict[str, Tensor]:
    """Return the same of all weights of some parts, by their names in `module`."""
    inside = {id(weight) for part in parts for weight in part.parameters()}
    named = module.named_parameters()
    return _rounded(device, ((name, weight) for name, weight in named if id(weight) in inside))


def _rounded(device: torch.device, named: Iterable[tuple[str, Tensor]]) -> dict[str, Tensor]:
    kind = device.type
    if kind == "meta" or not torch.is_autocast_enabled(kind):
        return {}
    to = torch.get_autocast_dtype(kind)
    found = {name: weight for name, weight in named if weight.dtype == torch.float32}
    if not found:
        return {}
    return dict(zip(found, _Together.apply(to, *found.values()), strict=True))


class _Together(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, to: torch.dtype, *weights: Tensor) -> tuple[Tensor, ...]:
        return _copies(weights, to)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_copies(grads, torch.float32)


def _copies(tensors: Iterable[Tensor], to: torch.dtype) -> tuple[Tensor, ...]:
    given = list(tensors)
    copies = [torch.empty_like(tensor, dtype=to) for tensor in given]
    torch._foreach_copy_(copies, given)
    return tuple(copies)
