"""The published picture head (DPT), as its operations are described: the 1x1 after the upsampling.

Part of `published_forward`, and like it only there to be measured against.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import conv2d, conv_transpose2d, elu, interpolate, silu

Weights = Mapping[str, Tensor]
"""Tensors under their published names."""

_HEAD = "view_transformer.out_dpt"
_ELU_ALPHA = 1e-3


def published_head(weights: Weights, taps_VQW: Sequence[Tensor]) -> Tensor:
    """Return log10(1 + radiance) [V, R, R, 3], behind the ELU, of four layers [V, Q, W]."""
    grids = [_grid(weights, level, tokens) for level, tokens in enumerate(taps_VQW)]
    fused: Tensor | None = None
    for level in reversed(range(len(grids))):
        height, width = grids[level - 1].shape[-2:]
        if level == 0:
            height, width = 2 * grids[0].shape[-2], 2 * grids[0].shape[-1]
        fused = _fuse(weights, level, fused, grids[level], (height, width))
    assert fused is not None
    last = f"{_HEAD}.scratch.output_conv"
    halved = _conv(weights, f"{last}1", fused, padding=1)
    widened = silu(_conv(weights, f"{last}2.0", halved, padding=1))
    picture_V3RR = elu(_conv(weights, f"{last}2.2", widened), alpha=_ELU_ALPHA)
    return torch.movedim(picture_V3RR, 1, -1)


def _grid(weights: Weights, level: int, tokens_VQW: Tensor) -> Tensor:
    """Return one layer's tokens as the grid of a level: 4, 2, 1 and half times the bundles."""
    per_side = round(tokens_VQW.shape[1] ** 0.5)
    grid_VWQQ = tokens_VQW.transpose(1, 2).unflatten(2, (per_side, per_side)).contiguous()
    grid = _conv(weights, f"{_HEAD}.projects.{level}", grid_VWQQ)
    resize = f"{_HEAD}.resize_layers.{level}"
    if level < 2:
        weight, bias = weights[f"{resize}.weight"], weights[f"{resize}.bias"]
        grid = conv_transpose2d(grid, weight, bias, stride=(4, 2)[level])
    elif level == 3:
        grid = _conv(weights, resize, grid, padding=1, stride=2)
    return _conv(weights, f"{_HEAD}.scratch.layer{level + 1}_rn", grid, padding=1)


def _fuse(
    weights: Weights, level: int, coarse: Tensor | None, grid: Tensor, size: tuple[int, int]
) -> Tensor:
    block = f"{_HEAD}.scratch.refinenet{level + 1}"
    if coarse is not None:
        grid = coarse + _residual(weights, f"{block}.resConvUnit1", grid)
    grid = _residual(weights, f"{block}.resConvUnit2", grid)
    large = interpolate(grid, size=size, mode="bilinear", align_corners=True)
    return _conv(weights, f"{block}.out_conv", large)


def _residual(weights: Weights, name: str, x: Tensor) -> Tensor:
    first = _conv(weights, f"{name}.conv1", silu(x), padding=1)
    return x + _conv(weights, f"{name}.conv2", silu(first), padding=1)


def _conv(weights: Weights, name: str, x: Tensor, *, padding: int = 0, stride: int = 1) -> Tensor:
    bias = weights.get(f"{name}.bias")
    return conv2d(x, weights[f"{name}.weight"], bias, padding=padding, stride=stride)
