"""Heads from bundle tokens to pixels: linear, or a dense prediction transformer (DPT).

The linear head is smaller and as good for minutes of training; the DPT (Ranftl et al. 2021) mixes
neighboring bundles, so that their borders do not show. Both start at a black picture, or,
where they predict light (model.demodulated), at equal dim light everywhere.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, silu

from model.config import NUM_TAPS, ModelConfig
from model.layers import LAYER_NORM_EPS, Norm
from model.precision import without_autocast
from model.rays import unbundle

LAST_CHANNELS = 32
"""Channels before the DPT's last 1x1, as published."""


def picture_channels(config: ModelConfig) -> int:
    """Return the number of channels of a head: a color, or two kinds of light."""
    return 6 if config.demodulated else 3


class LinearHead(nn.Module):
    """Linear map of the last layer's tokens to P x P pixels each."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.patch_px = config.patch_px
        self.taps = (config.decoder_layers - 1,)
        self.norm = Norm(config.width, eps=LAYER_NORM_EPS)
        self.last = nn.Linear(config.width, picture_channels(config) * config.patch_px**2)

    def forward(self, taps_MQW: Sequence[Tensor]) -> Tensor:
        """Return pictures [M, channels, R, R]."""
        tokens_MQW = taps_MQW[0].to(self.last.weight.dtype)
        with without_autocast(tokens_MQW.device):
            return unbundle(self.last(self.norm(tokens_MQW)), self.patch_px)

    def rounded_parts(self) -> list[nn.Module]:
        """Return no module, since rounding of the last layer would be visible."""
        return []


class ResidualConv(nn.Module):
    """x + two 3x3 convolutions, each after a SiLU."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(features, features, 3, padding=1)
        self.second = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x_MCHW: Tensor) -> Tensor:
        """[M, C, H, W] -> [M, C, H, W]."""
        return x_MCHW + self.second(silu(self.first(silu(x_MCHW))))


class BilinearUpsample(torch.autograd.Function):
    """Bilinear upsampling with aligned corners, whose backward pass is two matrix products.

    Torch's own backward pass adds with atomics: compiled, it takes 17 of 195 ms of a step of Base
    on an H100, and sums in a random order (study S87).
    """

    @staticmethod
    def forward(x_MCHW: Tensor, size: tuple[int, int]) -> Tensor:
        """Return [M, C, *size]."""
        return interpolate(x_MCHW, size=size, mode="bilinear", align_corners=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, tuple[int, int]], output: Tensor) -> None:
        """Save the input's size: the map is linear, so backward needs no values."""
        ctx.small = inputs[0].shape[-2:]

    @staticmethod
    def backward(ctx: Any, gradient_MCHW: Tensor) -> tuple[Tensor, None]:
        """Return the gradient of x, in the type of the output's gradient."""
        height, width = ctx.small
        rows = _line_weights(height, gradient_MCHW.shape[-2], gradient_MCHW)
        columns = _line_weights(width, gradient_MCHW.shape[-1], gradient_MCHW)
        return rows @ gradient_MCHW @ columns.T, None


def _line_weights(short: int, long: int, like: Tensor) -> Tensor:
    """Return the interpolation weights [short, long] between points on a line."""
    dtype = torch.promote_types(like.dtype, torch.float32)  # as in the forward pass
    points = torch.eye(short, dtype=dtype, device=like.device)[None]
    weights = interpolate(points, size=long, mode="linear", align_corners=True)[0]
    return weights.to(like.dtype)


class Fusion(nn.Module):
    """Adds a grid to the coarser sum, and upsamples the result to the next finer grid."""

    def __init__(self, features: int, *, deepest: bool) -> None:
        super().__init__()
        self.skip = None if deepest else ResidualConv(features)
        self.refine = ResidualConv(features)
        self.project = nn.Conv2d(features, features, 1)

    def forward(
        self, coarse_MCHW: Tensor | None, grid_MCHW: Tensor, size: tuple[int, int]
    ) -> Tensor:
        """Return [M, C, *size].

        The 1x1 runs before the upsampling, where it costs a quarter; bilinear weights add up to
        one, so the result is the same but for rounding.
        """
        if self.skip is not None and coarse_MCHW is not None:
            grid_MCHW = coarse_MCHW + self.skip(grid_MCHW)
        fused = self.project(self.refine(grid_MCHW))
        return BilinearUpsample.apply(fused, size)


class DptHead(nn.Module):
    """DPT from four decoder layers over grids (4x, 2x, 1x, 1/2 of the bundles) to a picture."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.taps = config.dpt_taps
        features = config.dpt_features
        channels = config.dpt_channels
        self.project = nn.ModuleList(nn.Conv2d(config.width, wide, 1) for wide in channels)
        self.resize = nn.ModuleList(
            [
                nn.ConvTranspose2d(channels[0], channels[0], 4, stride=4),
                nn.ConvTranspose2d(channels[1], channels[1], 2, stride=2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, stride=2, padding=1),
            ]
        )
        self.reassemble = nn.ModuleList(
            nn.Conv2d(wide, features, 3, padding=1, bias=False) for wide in channels
        )
        self.fuse = nn.ModuleList(
            Fusion(features, deepest=level == NUM_TAPS - 1) for level in range(NUM_TAPS)
        )
        self.halve = nn.Conv2d(features, features // 2, 3, padding=1)
        self.widen = nn.Conv2d(features // 2, LAST_CHANNELS, 3, padding=1)
        self.last = nn.Conv2d(LAST_CHANNELS, picture_channels(config), 1)

    def forward(self, taps_MQW: Sequence[Tensor]) -> Tensor:
        """Return pictures [M, channels, R, R]."""
        grids = [self._grid(level, tokens) for level, tokens in enumerate(taps_MQW)]
        fused: Tensor | None = None
        for level in reversed(range(NUM_TAPS)):
            height, width = grids[level - 1].shape[-2:]
            if level == 0:
                height = 2 * grids[0].shape[-2]
                width = 2 * grids[0].shape[-1]
            fused = self.fuse[level](fused, grids[level], (height, width))
        halved = self.halve(fused).to(self.last.weight.dtype)
        with without_autocast(halved.device):
            return self.last(silu(self.widen(halved)))

    def rounded_parts(self) -> list[nn.Module]:
        """Return all modules but the last two layers, whose rounding would be visible."""
        return [self.project, self.resize, self.reassemble, self.fuse, self.halve]

    def _grid(self, level: int, tokens_MQW: Tensor) -> Tensor:
        per_side = round(tokens_MQW.shape[1] ** 0.5)
        grid_MWQQ = tokens_MQW.transpose(1, 2).unflatten(2, (per_side, per_side))
        return self.reassemble[level](self.resize[level](self.project[level](grid_MWQQ)))
