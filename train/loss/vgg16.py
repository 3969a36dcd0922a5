"""The convolutions of VGG16 (Simonyan and Zisserman 2015, configuration D), up to relu5_3.

Built from a state dict with torchvision's names, whose shapes also say how wide the layers are;
torchvision itself is not needed.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from storage.errors import TrilightError

BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Numbers of the convolutions in torchvision's `features`; a pooling stands between two blocks."""

MIN_PX = 16
"""Four poolings halve the picture; the last block needs a pixel."""


class Vgg16(nn.Module):
    """Pictures -> what the last convolution of each block sees. It is never trained."""

    def __init__(self, state: Mapping[str, Tensor]) -> None:
        """Take the weights `features.<n>.weight` and `.bias`; others are left alone.

        Raises:
            TrilightError: one is missing, or does not fit to the one before it.
        """
        super().__init__()
        self.convolutions = nn.ModuleList()
        channels = 3
        for number in (number for block in BLOCKS for number in block):
            names = [f"features.{number}.{part}" for part in ("weight", "bias")]
            weight, bias = (_found(state, name) for name in names)
            if weight.shape[1:] != (channels, 3, 3) or bias.shape != weight.shape[:1]:
                raise TrilightError(
                    f"VGG16: {names[0]} has the shape {tuple(weight.shape)}; expected "
                    f"(any, {channels}, 3, 3) and a bias for each. Use torchvision's vgg16 file."
                )
            convolution = nn.Conv2d(channels, len(weight), 3, padding=1)
            convolution.load_state_dict({"weight": weight, "bias": bias})
            self.convolutions.append(convolution)
            channels = len(weight)
        self.requires_grad_(False)

    def forward(self, picture_M3RR: Tensor) -> list[Tensor]:
        """Return the five tapped grids [M, C, R / 2^k, R / 2^k] of pictures, k = 0 ... 4."""
        x, taps, layers = picture_M3RR, [], iter(self.convolutions)
        for index, block in enumerate(BLOCKS):
            if index:
                x = nn.functional.max_pool2d(x, 2)
            for _ in block:
                x = torch.relu(next(layers)(x))
            taps.append(x)
        return taps


def _found(state: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in state:
        raise TrilightError(
            f"VGG16: the file has no {name}; expected the state dict of torchvision's vgg16."
        )
    return state[name].float()
