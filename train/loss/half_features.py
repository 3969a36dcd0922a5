"""Features in float16 between float32 pictures and float32 distances.

float16 keeps as many bits of a number as TF32 does, in which torch lets a card multiply float32
convolutions: a feature is rounded to them when it is written, and not when the next convolution
reads it. So the same rounding comes at half the bytes and, on a card, at the rate of few bits. What
float16 lacks is range. Gradients of a mean over pixels are tiny, so they are made larger by a power
of two on their way through; features above 65504 overflow, and the step is skipped.
"""

import math
from typing import Any

import torch
from torch import Tensor

MARGIN = 16


def gradient_scale(pictures_M3RR: Tensor) -> float:
    """Return the power of two by which gradients pass.

    The loss is a mean over pixels, so it grows with their number. Times MARGIN a twentieth of a
    mean over all pictures, as runs weigh it, lies in the middle of what float16 holds.
    """
    count, _, height, width = pictures_M3RR.shape
    return 2.0 ** round(math.log2(MARGIN * count * height * width))


def to_half(pictures_M3RR: Tensor, scale: float) -> Tensor:
    """Return the pictures in float16; on the way back gradients leave their scale again."""
    half: Tensor = _Cast.apply(pictures_M3RR, torch.float16, torch.float32, 1 / scale)
    return half


def from_half(features_MCHW: Tensor, scale: float) -> Tensor:
    """Return features in float32; on the way back gradients are scaled."""
    single: Tensor = _Cast.apply(features_MCHW, torch.float32, torch.float16, scale)
    return single


class _Cast(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, to: torch.dtype, back: torch.dtype, scale: float) -> Tensor:
        ctx.back, ctx.scale = back, scale
        return x.to(to)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        # in float32, where a scale neither overflows nor rounds
        return (grads[0].float() * ctx.scale).to(ctx.back), None, None, None
