"""How rates and initial weights follow the width of a network: the maximal update parametrisation.

One learning rate is best at every width where a step changes what each layer gives by an equal
share at every width (Yang et al. 2021). For a matrix from n inputs to m outputs that means initial
weights and steps of a spectral norm in proportion to sqrt(m / n) (Yang, Simon and Bernstein 2023).
With n0 and m0 at the base width, where everything is as it is without:

| | initial weights | AdamW's rate | Muon's rate |
|---|---|---|---|
| n and m grow | as Xavier's: sqrt(n0 / n) | n0 / n | sqrt(n0 / n) |
| only n grows | n0 / n | n0 / n | as the spectral norm asks |
| only m grows, vectors | as at the base | 1 | 1 |

Muon's rate is beside steps of 0.2 sqrt(max(m, n)) times an orthogonal matrix (Liu et al. 2025),
which have equal elements at every width, and so a spectral norm that grows.

Heads that grow wider are asked by d instead of sqrt(d). Their scale is a gain of the query's norm
here, and the scale of an output is a rate of its matrix: so a network that was trained with them is
one like any other, whose pictures need nothing of this.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import nn

from model.base_widths import BaseWidths
from model.hits.decoder import PixelHead
from model.layers import CrossAttention, SelfAttention
from model.renderformer import RenderFormer

_TRANSPOSED = (nn.ConvTranspose2d,)
_MATRICES = (nn.Linear, nn.Conv2d, *_TRANSPOSED)


@dataclass(frozen=True, kw_only=True)
class WidthScale:
    """Factors of one weight of a network; 1 each at the base width."""

    start: float = 1.0
    """Of its initial value."""
    adamw: float = 1.0
    """Of AdamW's learning rate."""
    muon: float = 1.0
    """Of Muon's learning rate, where Muon moves it."""

    def times(self, factor: float) -> "WidthScale":
        """Return these, all times a factor: of what is multiplied by a scale that no weight is."""
        return WidthScale(
            start=self.start * factor, adamw=self.adamw * factor, muon=self.muon * factor
        )


def width_scales(model: RenderFormer, base: BaseWidths) -> dict[str, WidthScale]:
    """Return the factors of every weight by its name; all 1 where no base width is stated."""
    scales = {name: WidthScale() for name, _ in model.named_parameters()}
    if not base.width:
        return scales
    with torch.device("meta"):
        at_base = RenderFormer(base.of(model.config))
    modules = dict(at_base.named_modules())
    for name, module in model.named_modules():
        if isinstance(module, _MATRICES):
            fans, base_fans = _fans(module), _fans(modules[name])
            scales[f"{name}.weight"] = _of_matrix(fans, base_fans)
    for name, factor in _questions(model, modules):
        scales[name] = scales[name].times(factor)
    return scales


@torch.no_grad()
def scale_start(model: RenderFormer, scales: Mapping[str, WidthScale]) -> None:
    """Bring weights as `RenderFormer.initialise` drew them to their size at this width."""
    for name, weight in model.named_parameters():
        if scales[name].start != 1:
            weight.mul_(scales[name].start)


def _fans(module: nn.Module) -> tuple[int, int]:
    """Return how many numbers a matrix takes for each of its outputs, and the reverse."""
    shape: torch.Size = module.weight.shape  # type: ignore[assignment]
    outputs, inputs = shape[:2] if not isinstance(module, _TRANSPOSED) else shape[1::-1]
    return inputs * math.prod(shape[2:]), outputs * math.prod(shape[2:])


def _of_matrix(fans: tuple[int, int], base_fans: tuple[int, int]) -> WidthScale:
    (n, m), (n0, m0) = fans, base_fans
    grown = n / n0
    wanted = 1 / math.sqrt(grown) if m != m0 else 1 / grown
    drawn = math.sqrt((n0 + m0) / (n + m))  # Xavier's, beside that at the base
    spectral = math.sqrt((m / m0) / grown)
    return WidthScale(
        start=wanted / drawn,
        adamw=1 / grown,
        muon=spectral * math.sqrt(max(n0, m0) / max(n, m)),
    )


def _questions(
    model: RenderFormer, at_base: Mapping[str, nn.Module]
) -> Iterator[tuple[str, float]]:
    """Yield the weights that scale what asks in an attention, each with its factor."""
    for name, module in model.named_modules():
        other = at_base[name]
        if isinstance(module, SelfAttention | CrossAttention):
            assert isinstance(other, SelfAttention | CrossAttention)
            yield f"{name}.q_norm.weight", math.sqrt(_head_width(other) / _head_width(module))
        elif isinstance(module, PixelHead):
            assert isinstance(other, PixelHead)
            factor = math.sqrt(other.query.out_features / module.query.out_features)
            yield from ((f"{name}.query.{part}", factor) for part in ("weight", "bias"))


def _head_width(attention: SelfAttention | CrossAttention) -> int:
    return attention.out.in_features // attention.num_heads
