"""LPIPS (Zhang et al. 2018), version 0.1 on VGG16: perceptual distance of two pictures.

Written in plain torch from the paper and the published weights' names; torchvision is not needed.
Values are LPIPS only with the published weights: without them a run must name another term, and
reports say n/a.

Trilight does not ship the weights, since VGG16 is 528 MB. They come from a folder or from their
publishers' servers. Both files are read with `weights_only`, so that nothing in them can run.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from storage.errors import TrilightError

BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
"""Indices of the convolutions in torchvision's `features`; a pooling separates two blocks."""

MIN_PX = 16
"""Minimum width of a picture: four poolings halve it, and the last block needs a pixel."""


SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""ImageNet's mean and spread per channel, for pictures in [-1, 1]."""

EPS = 1e-10
"""Minimum length of a feature vector, to avoid a division by 0."""


class Lpips(nn.Module):
    """Distance of pairs of pictures, 0 for equal ones.

    It compares features of VGG16 (Simonyan and Zisserman 2015, configuration D) up to relu5_3,
    which is never trained. The shapes in its state dict define the widths of the layers.
    """

    shift_311: Tensor
    scale_311: Tensor

    def __init__(self, vgg16: Mapping[str, Tensor], linear: Mapping[str, Tensor]) -> None:
        """Build the network.

        Args:
            vgg16: `features.<n>.weight` and `.bias`, torchvision's names; others are ignored.
            linear: the published linear weights, `lin<k>.model.1.weight` [1, C, 1, 1] for the
                block k.

        Raises:
            TrilightError: a tensor is missing or has another shape.
        """
        super().__init__()
        self.convolutions = nn.ModuleList()
        self.register_buffer("shift_311", torch.tensor(SHIFT).reshape(3, 1, 1))
        self.register_buffer("scale_311", torch.tensor(SCALE).reshape(3, 1, 1))
        width = 3
        for block, numbers in enumerate(BLOCKS):
            for number in numbers:
                self.convolutions.append(_convolution(vgg16, number, width))
                width = len(vgg16[f"features.{number}.weight"])
            name = f"lin{block}.model.1.weight"
            weight = linear.get(name)
            if weight is None or weight.shape != (1, width, 1, 1):
                got = "missing" if weight is None else tuple(weight.shape)
                raise TrilightError(
                    f"LPIPS: {name} is {got}; expected the shape (1, {width}, 1, 1). Use the file "
                    "vgg.pth of version 0.1 of LPIPS."
                )
            self.register_buffer(f"linear_{block}", weight.float())
        self.requires_grad_(False)

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
            linear_1C11 = self.get_buffer(f"linear_{block}")
            squared = (_unit(a_MCHW) - _unit(b_MCHW)) ** 2
            # a sum, and no convolution to one channel: compiled, no square is ever written
            weighed_MHW = (squared * linear_1C11).sum(dim=1)
            distance_M = distance_M + weighed_MHW.mean(dim=(1, 2))
        return distance_M

    def _features(self, picture_M3RR: Tensor) -> list[Tensor]:
        """Return the last grid of each block k, [M, C, R / 2^k, R / 2^k]."""
        x = (2 * picture_M3RR - 1 - self.shift_311) / self.scale_311
        grids = []
        layers = iter(self.convolutions)
        for index, block in enumerate(BLOCKS):
            if index:
                x = nn.functional.max_pool2d(x, 2)
            for _ in block:
                x = torch.relu(next(layers)(x))
            grids.append(x)
        return grids


def _convolution(state: Mapping[str, Tensor], number: int, channels: int) -> nn.Conv2d:
    """Return a convolution of VGG16 with its weights; raises as `Lpips`."""
    names = [f"features.{number}.{part}" for part in ("weight", "bias")]
    if missing := [name for name in names if name not in state]:
        raise TrilightError(
            f"VGG16: the file has no {missing[0]}; expected the state dict of torchvision's vgg16."
        )
    weight, bias = (state[name].float() for name in names)
    if weight.shape[1:] != (channels, 3, 3) or bias.shape != weight.shape[:1]:
        raise TrilightError(
            f"VGG16: {names[0]} has the shape {tuple(weight.shape)}; expected (any, {channels}, 3, "
            "3) and a bias for each. Use torchvision's vgg16 file."
        )
    convolution = nn.Conv2d(channels, len(weight), 3, padding=1)
    convolution.load_state_dict({"weight": weight, "bias": bias})
    return convolution


def _unit(x_MCHW: Tensor) -> Tensor:
    """Normalize features to unit length per pixel; zeros stay 0, and so does their gradient."""
    length = (x_MCHW.square().sum(dim=1, keepdim=True) + EPS**2).sqrt()
    return x_MCHW / (length + EPS)


VGG16_FILE = "vgg16-397923af.pth"
"""File name of torchvision's VGG16; it includes the start of its sha256."""

LINEAR_FILE = "vgg.pth"
"""File name of the linear weights of LPIPS 0.1 on VGG16 (6 KB)."""

VGG16_URL = f"https://download.pytorch.org/models/{VGG16_FILE}"
LINEAR_URL = (
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"
    f"{LINEAR_FILE}"
)

HUB = "hub"
"""Value in place of a folder that downloads the files into torch's cache."""

VARIABLE = "TRILIGHT_LPIPS"
"""Environment variable with the default folder."""


def load_lpips(source: str | None) -> Lpips | None:
    """Return LPIPS with its published weights, or None if no source is named.

    Args:
        source: folder with VGG16_FILE and LINEAR_FILE, or `hub`; None reads TRILIGHT_LPIPS.

    Raises:
        TrilightError: a file is missing, is no state dict, or cannot be downloaded.
    """
    source = source or os.environ.get(VARIABLE) or None
    if source is None:
        return None
    return Lpips(_state(source, VGG16_URL), _state(source, LINEAR_URL))


def _state(source: str, url: str) -> dict[str, Tensor]:
    """Return the state dict of a published file, from its URL or from the folder `source`."""
    is_hub = source == HUB
    path = Path(source) / url.rpartition("/")[2]
    if not is_hub and not path.is_file():
        raise TrilightError(
            f"LPIPS: {path} does not exist; expected {VGG16_FILE} (torchvision) and {LINEAR_FILE} "
            f"(LPIPS 0.1) in that folder, or `{HUB}` in its place to download them."
        )
    where = url if is_hub else str(path)
    loads: dict[str, Any] = {"map_location": "cpu", "weights_only": True}
    load: Any = torch.load
    if is_hub:
        load = torch.hub.load_state_dict_from_url
        loads |= {"check_hash": url == VGG16_URL, "progress": False}
    try:
        state: Any = load(where, **loads)
    except Exception as error:  # torch raises whatever the damage or the network leads to
        problem = f"is not readable ({type(error).__name__})"
        if is_hub:
            problem = (
                f"could not be downloaded ({error}); name a folder that holds {VGG16_FILE} and "
                f"{LINEAR_FILE} instead"
            )
        raise TrilightError(f"LPIPS: {where} {problem}.") from error
    if not isinstance(state, dict) or not all(isinstance(t, Tensor) for t in state.values()):
        raise TrilightError(f"LPIPS: {where} holds no state dict; expected tensors by name.")
    return state
