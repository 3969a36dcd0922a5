"""The kernels that a torch with CUDA chooses, where one without it would choose others.

Inside `cuda_kernels()`, on the card that is not there: attention in one kernel (flash in half
precision without a mask, the memory-efficient one otherwise), norms in one, and lists of tensors in
kernels over lists. Everything else chooses alike.
"""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor
from torch.optim.adamw import AdamW
from torch.utils import _foreach_utils

from model import attention

_optimizer = sys.modules[AdamW.__mro__[2].__module__]
"""torch.optim takes the module's name out of its own reach."""

_OWN = ("silu_backward",)
"""Operations that are one kernel on CUDA; a torch without it has them as sums of others."""

_HALVES = (torch.bfloat16, torch.float16)


@contextmanager
def cuda_kernels() -> Iterator[None]:
    """Have them chosen for as long as it lasts."""
    with ExitStack() as stack:
        for owner, name, chosen in (
            (attention, "scaled_dot_product_attention", _attention),
            (torch.nn.functional, "rms_norm", _norm),
            (_optimizer, "_foreach_supported_types", _Any()),
            (_foreach_utils, "_foreach_supported_types", _Any()),
        ):
            stack.enter_context(mock.patch.object(owner, name, chosen))
        for name in _OWN:
            library = stack.enter_context(torch.library._scoped_library("aten", "IMPL"))
            library.impl(name, _never, "CUDA")
        yield


def _never(*_: Any) -> Tensor:
    raise NotImplementedError("there is no card")


class _Any(list[type]):
    """Types whose lists have kernels of their own: here fake tensors too."""

    def __init__(self) -> None:
        super().__init__([Tensor, torch.nn.Parameter, FakeTensor])


class _FusedNorm(torch.autograd.Function):
    """RMSNorm as CUDA has it: one kernel there, and one back, whose operators CPU builds lack."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight, x.new_empty(x.shape[:-1], dtype=torch.float32))
        normed: Tensor = torch.ops.trilight_roofline.norm(x, weight)
        return normed

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        found: tuple[Tensor, Tensor] = torch.ops.trilight_roofline.norm_backward(
            *grads, *ctx.saved_tensors
        )
        return found


def _norm(x: Tensor, shape: Any, weight: Tensor, eps: float | None = None) -> Tensor:
    normed: Tensor = _FusedNorm.apply(x, weight)
    return normed


@torch.library.custom_op("trilight_roofline::norm", mutates_args=())
def _forward_kernel(x: Tensor, weight: Tensor) -> Tensor:
    return torch.empty_like(x)


@torch.library.custom_op("trilight_roofline::norm_backward", mutates_args=())
def _backward_kernel(
    grad: Tensor, x: Tensor, weight: Tensor, rstd: Tensor
) -> tuple[Tensor, Tensor]:
    return torch.empty_like(x), torch.empty_like(weight)


_forward_kernel.register_fake(lambda x, weight: torch.empty_like(x))
_backward_kernel.register_fake(
    lambda grad, x, weight, rstd: (torch.empty_like(x), torch.empty_like(weight))
)


def _attention(q: Tensor, k: Tensor, v: Tensor, attn_mask: Tensor | None = None) -> Tensor:
    """Choose as torch does; autocast has it compute in half precision."""
    if torch.is_autocast_enabled("cuda"):
        half = torch.get_autocast_dtype("cuda")
        q, k, v = (each.to(half) for each in (q, k, v))
    with torch.autocast("cuda", enabled=False):
        if attn_mask is None and q.dtype in _HALVES:
            found: Tensor = torch.ops.aten._scaled_dot_product_flash_attention(q, k, v)[0]
            return found
        bias = None
        if attn_mask is not None:
            bias = torch.zeros_like(attn_mask, dtype=q.dtype)
            bias = bias.masked_fill(attn_mask, 0.0).expand(*q.shape[:3], k.shape[2])
        kernel = torch.ops.aten._scaled_dot_product_efficient_attention
        found = kernel(q, k, v, bias, torch.is_grad_enabled())[0]
        return found
