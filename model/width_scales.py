"""Maximal update parametrization (muP): scaling of rates and initial weights with the width.

One learning rate is best at every width if a step changes the output of each layer by an equal
fraction at every width (Yang et al. 2021). For a matrix from n inputs to m outputs this needs
initial weights and steps whose spectral norm is proportional to sqrt(m / n) (Yang, Simon and
Bernstein 2023). With n0 and m0 at the base width, where nothing is scaled:

| | initial weights | AdamW's rate | Muon's rate |
|---|---|---|---|
| n and m grow | as Xavier's: sqrt(n0 / n) | n0 / n | sqrt(n0 / n) |
| only n grows | n0 / n | n0 / n | by the spectral norm |
| only m grows, vectors | as at the base | 1 | 1 |

Muon's rate multiplies steps of 0.2 sqrt(max(m, n)) times an orthogonal matrix (Liu et al. 2025),
which have elements of equal size at every width, and so a spectral norm that grows.

Attention of wider heads is divided by d instead of sqrt(d). This scale is part of the gain of the
query's norm, and the scale of an output is part of the rate of its matrix, so that inference needs
no scales.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from model.config import BaseWidths
from model.hits.decoder import PixelHead
from model.layers import CrossAttention, SelfAttention
from model.renderformer import RenderFormer

_TRANSPOSED = (nn.ConvTranspose2d,)
_MATRICES = (nn.Linear, nn.Conv2d, *_TRANSPOSED)


@dataclass(frozen=True, kw_only=True)
class WidthScale:
    """Factors of one weight of a network; all are 1 at the base width."""

    start: float = 1.0
    """Factor of its initial value."""
    adamw: float = 1.0
    """Factor of AdamW's learning rate."""
    muon: float = 1.0
    """Factor of Muon's learning rate, if Muon updates it."""


def width_scales(model: RenderFormer, base: BaseWidths) -> dict[str, WidthScale]:
    """Return the factors of every weight by name; all are 1 without a base width."""
    scales = {name: WidthScale() for name, _ in model.named_parameters()}
    if not base.width:
        return scales
    with torch.device("meta"):
        at_base = RenderFormer(base.of(model.config))
    modules = dict(at_base.named_modules())
    for name, module in model.named_modules():
        if isinstance(module, _MATRICES):
            fans = _fans(module)
            base_fans = _fans(modules[name])
            scales[f"{name}.weight"] = _of_matrix(fans, base_fans)
    for name, factor in _query_scales(model, modules):
        factors = vars(scales[name])
        scales[name] = WidthScale(**{each: factors[each] * factor for each in factors})
    return scales


@torch.no_grad()
def scale_start(model: RenderFormer, scales: Mapping[str, WidthScale]) -> None:
    """Scale the weights from `RenderFormer.initialize` to their size at this width."""
    for name, weight in model.named_parameters():
        if scales[name].start != 1:
            weight.mul_(scales[name].start)


def _fans(module: nn.Module) -> tuple[int, int]:
    """Return the fan-in and fan-out of a matrix or convolution."""
    shape: torch.Size = module.weight.shape  # type: ignore[assignment]
    outputs, inputs = shape[:2] if not isinstance(module, _TRANSPOSED) else shape[1::-1]
    return inputs * math.prod(shape[2:]), outputs * math.prod(shape[2:])


def _of_matrix(fans: tuple[int, int], base_fans: tuple[int, int]) -> WidthScale:
    n, m = fans
    n0, m0 = base_fans
    growth = n / n0
    target_start = 1 / math.sqrt(growth) if m != m0 else 1 / growth
    xavier_start = math.sqrt((n0 + m0) / (n + m))  # Xavier's, beside that at the base
    spectral = math.sqrt((m / m0) / growth)
    return WidthScale(
        start=target_start / xavier_start,
        adamw=1 / growth,
        muon=spectral * math.sqrt(max(n0, m0) / max(n, m)),
    )


def _query_scales(model: RenderFormer, at_base: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the weights that scale the queries of an attention, each with its factor."""
    for name, module in model.named_modules():
        other = at_base[name]
        if isinstance(module, SelfAttention | CrossAttention):
            yield f"{name}.q_norm.weight", math.sqrt(_head_width(other) / _head_width(module))
        elif isinstance(module, PixelHead):
            factor = math.sqrt(other.query.out_features / module.query.out_features)
            yield from ((f"{name}.query.{part}", factor) for part in ("weight", "bias"))


def _head_width(attention: SelfAttention | CrossAttention) -> int:
    return attention.out.in_features // attention.num_heads
