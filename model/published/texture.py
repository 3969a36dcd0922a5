"""The published material encoder, which reads a 13 x P x P texture, as a map of ten numbers.

Its input is always the same 13 numbers in every cell (x, y) with x + y <= P, and zero elsewhere,
and three of them, the tangent-space normal, are always (0.5, 0.5, 1). So its weights may be summed
over those cells, and the normal's share of the result belongs to the bias: the same function at a
thousandth of the input and 10 million fewer weights (P = 32).
"""

import torch
from torch import Tensor

TEXTURE_CHANNELS = 13
NORMAL = slice(7, 10)
"""Of the channels: diffuse 3, specular 3, roughness 1, tangent-space normal 3, emission 3."""

TANGENT_NORMAL = (0.5, 0.5, 1.0)


def fold(weight_WC: Tensor, bias_W: Tensor, patch: int) -> tuple[Tensor, Tensor]:
    """Return weight [W, 10] and bias [W] for the published weight [W, 13 P P] and bias.

    Sums in float64, returns the type it was given.
    """
    cells = weight_WC.double().unflatten(1, (TEXTURE_CHANNELS, patch, patch))
    place = torch.arange(patch, device=weight_WC.device)
    thirteen = (cells * (place[:, None] + place <= patch)).sum(dim=(-2, -1))
    normal = torch.tensor(TANGENT_NORMAL, dtype=torch.float64, device=weight_WC.device)
    bias = bias_W.double() + (thirteen[:, NORMAL] * normal).sum(dim=1)
    ten = torch.cat([thirteen[:, : NORMAL.start], thirteen[:, NORMAL.stop :]], dim=1)
    return ten.to(weight_WC.dtype), bias.to(bias_W.dtype)


def unfold(weight_WC: Tensor, bias_W: Tensor, patch: int) -> tuple[Tensor, Tensor]:
    """Return a published weight [W, 13 P P] and bias that `fold` turns into these, bit by bit.

    What was summed cannot be told apart again: the whole weight stands in the first cell, and the
    normal's columns are zero.
    """
    cells = weight_WC.new_zeros((len(weight_WC), TEXTURE_CHANNELS, patch, patch))
    cells[:, : NORMAL.start, 0, 0] = weight_WC[:, : NORMAL.start]
    cells[:, NORMAL.stop :, 0, 0] = weight_WC[:, NORMAL.start :]
    return cells.flatten(1), bias_W.clone()
