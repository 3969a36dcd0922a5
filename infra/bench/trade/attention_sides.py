"""One attention layer, several ways, on the same numbers."""

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

from infra.bench.model.cases import timed_forward
from infra.bench.trade.forward import CPU
from model.attention import attend

DEFAULT = "fused"
"""What the network does, in float32."""

Sides = dict[str, Callable[[], Mapping[str, float]]]


def attention_sides(q: Tensor, k: Tensor, v: Tensor, outputs: dict[str, Tensor]) -> Sides:
    """Return the ways to attend; each leaves its answer in `outputs`.

    Args:
        q, k, v: [1, H, N, D] float32.
        outputs: filled by name.
    """
    rounded = (q.bfloat16(), k.bfloat16(), v.bfloat16())
    every_key = torch.ones(1, k.shape[2], dtype=torch.bool)

    def plain() -> Tensor:
        with sdpa_kernel(SDPBackend.MATH):
            return attend(q, k, v, None)

    ways: dict[str, Callable[[], Tensor]] = {
        DEFAULT: lambda: attend(q, k, v, None),
        "fused, bfloat16": lambda: attend(*rounded, None),
        "fused, with a mask": lambda: attend(q, k, v, every_key),
        "torch's own products": plain,
    }
    return {name: _timed(name, way, outputs) for name, way in ways.items()}


def _timed(
    name: str, way: Callable[[], Tensor], outputs: dict[str, Tensor]
) -> Callable[[], Mapping[str, float]]:
    def run() -> Mapping[str, float]:
        outputs[name], figures = timed_forward(way, CPU)
        return figures

    return run


def exact_attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Return the same in float64, written out."""
    q, k, v = q.double(), k.double(), v.double()
    scores = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])
    return scores.softmax(dim=-1) @ v
