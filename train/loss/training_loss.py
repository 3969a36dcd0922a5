"""Training loss: L1 on log10(1 + radiance), a perceptual term, and the weight of each view.

SSIM, structural similarity, is at one scale (Wang et al. 2004) and several (Wang et al. 2003).

LPIPS (Zhang et al. 2018), version 0.1 on VGG16, is written in plain torch from the paper and the
published weights' names; torchvision is not needed. Values are LPIPS only with the published
weights: without them a run must name another term, and reports say n/a. Trilight does not ship the
weights, since VGG16 is 528 MB. They come from a folder or from their publishers' servers. Both
files are read with `weights_only`, so that nothing in them can run.
"""

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d

from storage.errors import TrilightError
from train.settings import LossSettings

WINDOW_PX = 11
SIGMA_PX = 1.5
K1 = 0.01
K2 = 0.03
"""Constants of both papers, for pictures in [0, 1]."""

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponent of each scale, finest first; with fewer scales they are brought to a sum of 1."""

MIN_STRUCTURE = 1e-4
"""Lower bound of a scale's mean, since a power of a negative number has no gradient."""


def ssim(a_M3RR: Tensor, b_M3RR: Tensor) -> Tensor:
    """Return the SSIM [M] of pictures in [0, 1]: Gaussian windows that lie within the picture.

    Equal to scikit-image's with gaussian_weights, sigma 1.5, use_sample_covariance off and the
    border left out, up to rounding.

    Raises:
        TrilightError: pictures below 11 pixels.
    """
    luminance, structure = _luminance_and_structure(a_M3RR, b_M3RR)
    return (luminance * structure).mean(dim=(1, 2, 3))


def ms_ssim(a_M3RR: Tensor, b_M3RR: Tensor) -> Tensor:
    """Return the multi-scale SSIM [M] of pictures in [0, 1].

    It uses as many of the five scales as are at least a window wide: 5 from 176 pixels, 3 at 64.

    Raises:
        TrilightError: pictures below 11 pixels.
    """
    scales = 1
    while scales < len(SCALE_WEIGHTS) and a_M3RR.shape[-1] >> scales >= WINDOW_PX:
        scales += 1
    weights = [weight / sum(SCALE_WEIGHTS[:scales]) for weight in SCALE_WEIGHTS[:scales]]
    product_M = a_M3RR.new_ones(len(a_M3RR))
    for scale, weight in enumerate(weights):
        luminance, structure = _luminance_and_structure(a_M3RR, b_M3RR)
        part = luminance * structure if scale == scales - 1 else structure
        product_M = product_M * part.mean(dim=(1, 2, 3)).clamp(min=MIN_STRUCTURE) ** weight
        a_M3RR = avg_pool2d(a_M3RR, 2)
        b_M3RR = avg_pool2d(b_M3RR, 2)
    return product_M


def _luminance_and_structure(a_M3RR: Tensor, b_M3RR: Tensor) -> tuple[Tensor, Tensor]:
    """Return luminance and contrast-structure of every window (2004, equations 6 and 13)."""
    if a_M3RR.shape[-1] < WINDOW_PX:
        raise TrilightError(
            f"SSIM: pictures of {a_M3RR.shape[-1]} pixels; expected at least {WINDOW_PX}, the "
            "width of its window."
        )
    mean_a = _blur(a_M3RR)
    mean_b = _blur(b_M3RR)
    var_a = _blur(a_M3RR.square()) - mean_a.square()
    var_b = _blur(b_M3RR.square()) - mean_b.square()
    covariance = _blur(a_M3RR * b_M3RR) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + K1**2) / (mean_a.square() + mean_b.square() + K1**2)
    structure = (2 * covariance + K2**2) / (var_a + var_b + K2**2)
    return luminance, structure


def _blur(x_M3RR: Tensor) -> Tensor:
    """Return the Gaussian means of windows that lie within the picture."""
    offset = torch.arange(WINDOW_PX, dtype=x_M3RR.dtype, device=x_M3RR.device) - WINDOW_PX // 2
    weight = torch.exp(-0.5 * (offset / SIGMA_PX) ** 2)
    kernel = (weight / weight.sum()).expand(3, 1, 1, -1)
    rows = conv2d(x_M3RR, kernel, groups=3)
    return conv2d(rows, kernel.transpose(2, 3), groups=3)


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


class TrainingLoss(nn.Module):
    """Loss function of a run's settings."""

    def __init__(self, settings: LossSettings, lpips: Lpips | None) -> None:
        """Create the loss; `lpips` is needed only if the settings use it.

        Raises:
            TrilightError: the settings use LPIPS and its weights are missing; no other term
                replaces it silently.
        """
        super().__init__()
        self.settings = settings
        # a module among them becomes a part of this one, and moves with it
        self._dissimilarity = _dissimilarity(settings, lpips)

    def forward(
        self, prediction_BVRR3: Tensor, target_BVRR3: Tensor, noise_BV: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the losses of each view.

        Args:
            prediction_BVRR3: log10(1 + radiance) before the ELU, float32.
            target_BVRR3: log10(1 + radiance).
            noise_BV: root mean square noise of the targets in the same space.

        Returns:
            [B, V] weighted sums of all terms, which training minimizes, and the L1 terms alone,
            unweighted and detached from the gradient.
        """
        # Zeng et al. 2025, section 4, first term, but before the ELU, whose slope is a thousandth
        # for negative values: a network that once predicts below 0 would hardly come back. Targets
        # are at least 0, so the best prediction is the same.
        l1_BV = (prediction_BVRR3 - target_BVRR3).abs().mean(dim=(2, 3, 4))
        total_BV = l1_BV
        if self._dissimilarity is not None:
            pictures = [
                tone_map(log10_BVRR3).flatten(0, 1).movedim(-1, 1)
                for log10_BVRR3 in (prediction_BVRR3, target_BVRR3)
            ]
            unlike_BV = self._dissimilarity(*pictures).reshape(l1_BV.shape)
            total_BV = total_BV + self.settings.perceptual_weight * unlike_BV
        half = self.settings.noise_half
        if half:
            total_BV = total_BV * (half / (half + noise_BV))
        return total_BV, l1_BV.detach()


def _dissimilarity(
    settings: LossSettings, lpips: Lpips | None
) -> Callable[[Tensor, Tensor], Tensor] | None:
    if settings.perceptual == "none" or settings.perceptual_weight == 0:
        return None
    if settings.perceptual == "ms_ssim":
        return lambda a_M3RR, b_M3RR: 1 - ms_ssim(a_M3RR, b_M3RR)
    if lpips is None:
        raise TrilightError(
            f"loss.perceptual is lpips, but no weights were named; give --lpips FOLDER with "
            f"{VGG16_FILE} and {LINEAR_FILE}, --lpips hub to download them, or another term: "
            "--set loss.perceptual=ms_ssim or none."
        )
    return lpips


LOG10_OF_2 = math.log10(2.0)


def tone_map(log10_rgb: Tensor) -> Tensor:
    """Return log10(1 + radiance), any shape, as clamp(log2(1 + radiance), 0, 1).

    The tone map of everything perceptual (Zeng et al. 2025, section 4). Radiance above
    1 is white and has no gradient here; the L1 term sees it. `preview_srgb8` of
    storage.conventions is the same curve, sRGB-encoded for people.
    """
    return (log10_rgb / LOG10_OF_2).clamp(0.0, 1.0)
