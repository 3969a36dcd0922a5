"""LPIPS (Zhang et al. 2018), version 0.1 on VGG16: how different two pictures look.

Written in plain torch from the paper and the published weights' names. Only with the published
weights are its values LPIPS; who has none must name another term, and reports then say n/a.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from storage.errors import TrilightError
from train.loss.vgg16 import BLOCKS, MIN_PX, Vgg16

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""ImageNet's mean and spread per channel, for pictures in [-1, 1]."""

EPS = 1e-10
"""Keeps the length of a feature vector above 0."""


class Lpips(nn.Module):
    """Pairs of pictures -> one distance each, 0 for equal ones."""

    shift_311: Tensor
    scale_311: Tensor

    def __init__(self, vgg16: Mapping[str, Tensor], linear: Mapping[str, Tensor]) -> None:
        """Build the network.

        Args:
            vgg16: state dict of torchvision's vgg16.
            linear: the published linear weights, `lin<k>.model.1.weight` [1, C, 1, 1] for the
                block k.

        Raises:
            TrilightError: a tensor is missing or has another shape.
        """
        super().__init__()
        self.vgg16 = Vgg16(vgg16)
        self.register_buffer("shift_311", torch.tensor(SHIFT).reshape(3, 1, 1))
        self.register_buffer("scale_311", torch.tensor(SCALE).reshape(3, 1, 1))
        widths = [len(vgg16[f"features.{block[-1]}.weight"]) for block in BLOCKS]
        for block, width in enumerate(widths):
            name = f"lin{block}.model.1.weight"
            weight = linear.get(name)
            if weight is None or weight.shape != (1, width, 1, 1):
                got = "missing" if weight is None else tuple(weight.shape)
                raise TrilightError(
                    f"LPIPS: {name} is {got}; expected the shape (1, {width}, 1, 1). Use the file "
                    "vgg.pth of version 0.1 of LPIPS."
                )
            self.register_buffer(f"linear_{block}", weight.float())

    def forward(self, a_M3RR: Tensor, b_M3RR: Tensor) -> Tensor:
        """Return the distances [M] of pictures in [0, 1], at least 16 pixels across.

        Raises:
            TrilightError: smaller pictures.
        """
        if min(a_M3RR.shape[-2:]) < MIN_PX:
            raise TrilightError(
                f"LPIPS: pictures of {min(a_M3RR.shape[-2:])} pixels; expected at least {MIN_PX}. "
                "Choose a higher resolution or another perceptual term."
            )
        distance_M = a_M3RR.new_zeros(len(a_M3RR))
        pairs = zip(self._features(a_M3RR), self._features(b_M3RR), strict=True)
        for block, (a_MCHW, b_MCHW) in enumerate(pairs):
            linear = self.get_buffer(f"linear_{block}")
            squared = (_unit(a_MCHW) - _unit(b_MCHW)) ** 2
            weighed = nn.functional.conv2d(squared, linear)
            distance_M = distance_M + weighed.mean(dim=(1, 2, 3))
        return distance_M

    def _features(self, picture_M3RR: Tensor) -> list[Tensor]:
        taps: list[Tensor] = self.vgg16((2 * picture_M3RR - 1 - self.shift_311) / self.scale_311)
        return taps


def _unit(x_MCHW: Tensor) -> Tensor:
    """Return features of unit length per pixel; where all are 0 they stay so, gradient and all."""
    length = (x_MCHW.square().sum(dim=1, keepdim=True) + EPS**2).sqrt()
    return x_MCHW / (length + EPS)
