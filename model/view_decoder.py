"""View stage (decoder): ray bundles of a camera attend to the scene; heads turn them to pixels.

It runs in camera space: rotating the keys transforms the context to each camera's space, and the
bundles are at the origin. The scene's tokens themselves are the same for every view, and two views
differ only in their field of view. Ray bundles are directions through pixel centers, patch by
patch, tested against storage.conventions.camera_rays, which is the definition.

A head reads bundle tokens: the linear one is smaller and as good for minutes of training; the DPT
(Ranftl et al. 2021) mixes neighboring bundles, so that their borders do not show. Both start at a
black picture, or, where they predict light (`compose_radiance`), at equal dim light everywhere.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle, pixel_unshuffle, silu, softplus

from model.attention import Packing, Windows, cut_windows
from model.config import NUM_TAPS, ModelConfig
from model.layers import LAYER_NORM_EPS, TOKEN_NORM_EPS, DecoderLayer, Norm, dtype_of, run_layer
from model.positions import (
    EncodedScene,
    KeysValues,
    TokenPositions,
    TriangleRotary,
    camera_rotation,
    packed_camera_rotation,
)
from model.precision import rounded_call, rounded_weights, without_autocast
from model.scene_tensors import Cameras


def ray_directions(fov_deg_V: Tensor, resolution: int) -> Tensor:
    """Return unit directions [..., 3, R, R] of square pictures; row 0 is the top.

    fov_deg [...] is the full angle in degrees; x points right, y up, and the camera looks along -z.
    """
    focal_px_V = 0.5 * resolution / torch.tan(torch.deg2rad(fov_deg_V) / 2)
    offset_R = torch.arange(resolution, dtype=fov_deg_V.dtype, device=fov_deg_V.device)
    offset_R = offset_R + 0.5 - 0.5 * resolution
    xyz_VRR = torch.broadcast_tensors(offset_R, -offset_R[:, None], -focal_px_V[..., None, None])
    direction_V3RR = torch.stack(xyz_VRR, dim=-3)
    return direction_V3RR / direction_V3RR.norm(dim=-3, keepdim=True)


def bundle_rays(direction_V3RR: Tensor, patch_px: int) -> Tensor:
    """[..., 3, R, R] -> [..., Q, 3 P P]: bundles row by row, each flattened channel-major."""
    return pixel_unshuffle(direction_V3RR, patch_px).flatten(-2).mT.contiguous()


def unbundle(bundles_MQC: Tensor, patch_px: int) -> Tensor:
    """[M, Q, C P P] -> [M, C, R, R]: the inverse of `bundle_rays` for a square picture."""
    per_side = round(bundles_MQC.shape[1] ** 0.5)
    return pixel_shuffle(bundles_MQC.mT.unflatten(2, (per_side, per_side)), patch_px)


_START_LIGHT = -1.5
"""Offset before softplus: the initial light of 0.6 in every pixel is about that of the scenes."""

_BRIGHTEST = 8.0
"""Maximum log10(1 + light): far above any lamp, and small enough for float32."""


def compose_radiance(light_BVRR6: Tensor, albedo_BVRR6: Tensor) -> Tensor:
    """Return log10(1 + radiance) [B, V, R, R, 3], at least 0, from predicted light and albedo.

        radiance = diffuse albedo * diffuse light + specular albedo * specular light

    The albedo of a pixel's visible surface is traced exactly, in milliseconds. So color textures,
    silhouettes and the black background need not be learned. Diffuse light is irradiance over pi;
    neither light is ever negative, and the network predicts both as log10(1 + x). Glossy reflection
    has no exact factor: its light contains a blurred mirror image.

    Args:
        light_BVRR6: output of a head; diffuse, then specular.
        albedo_BVRR6: albedo in the same order (model.hits.tracing).
    """
    with without_autocast(light_BVRR6.device):
        log10_BVRR6 = softplus(light_BVRR6 + _START_LIGHT).clamp(max=_BRIGHTEST)
        reflected = albedo_BVRR6 * torch.expm1(log10_BVRR6 * math.log(10))
        return torch.log1p(reflected[..., :3] + reflected[..., 3:]) / math.log(10)


LAST_CHANNELS = 32
"""Channels before the DPT's last 1x1, as published."""


def picture_channels(config: ModelConfig) -> int:
    """Return the number of channels of a head: a color, or two kinds of light."""
    return 6 if config.demodulated else 3


class LinearHead(nn.Module):
    """Linear map of the last layer's tokens to P x P pixels each."""

    rounded_parts: Sequence[nn.Module] = ()  # rounding of the last layer would be visible

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
            side = grids[level - 1].shape[-1] if level else 2 * grids[0].shape[-1]
            fused = self.fuse[level](fused, grids[level], (side, side))
        halved = self.halve(fused).to(self.last.weight.dtype)
        with without_autocast(halved.device):
            return self.last(silu(self.widen(halved)))

    @property
    def rounded_parts(self) -> Sequence[nn.Module]:
        """All modules but the last two layers, whose rounding would be visible."""
        return [self.project, self.resize, self.reassemble, self.fuse, self.halve]

    def _grid(self, level: int, tokens_MQW: Tensor) -> Tensor:
        per_side = round(tokens_MQW.shape[1] ** 0.5)
        grid_MWQQ = tokens_MQW.transpose(1, 2).unflatten(2, (per_side, per_side))
        return self.reassemble[level](self.resize[level](self.project[level](grid_MWQQ)))


class ViewDecoder(nn.Module):
    """Decoder from context and cameras to pictures."""

    def __init__(self, config: ModelConfig, rotary: TriangleRotary) -> None:
        super().__init__()
        self.rotary = rotary
        self.patch_px = config.patch_px
        self.window_bundles = config.window_bundles
        self.recompute = False
        self.token_W = nn.Parameter(torch.zeros(config.width))
        self.rays = nn.Linear(3 * config.patch_px**2, config.width)
        self.rays_norm = Norm(config.width, eps=TOKEN_NORM_EPS)
        self.layers = nn.ModuleList(
            DecoderLayer(config.width, config.num_heads, config.hidden_width)
            for _ in range(config.decoder_layers)
        )
        is_dpt = config.head == "dpt"
        self.head: LinearHead | DptHead = DptHead(config) if is_dpt else LinearHead(config)

    def keys_values(
        self, context_BNW: Tensor, places: TokenPositions, packing: Packing | None = None
    ) -> tuple[KeysValues, ...]:
        """Return each layer's keys and values of a context: once per scene, for any views.

        Keys are not rotated yet, since that needs a camera.
        """
        layers = cast(Iterable[DecoderLayer], self.layers)
        return tuple(layer.cross.keys_values(context_BNW) for layer in layers)

    def forward(self, scene: EncodedScene, cameras: Cameras, resolution: int) -> Tensor:
        """Return log10(1 + radiance) before the ELU, [B, V, R, R, 3].

        A demodulated network returns light, [B, V, R, R, 6] (`compose_radiance`).
        """
        # packed keys are grouped by view, so views come before scenes for the bundles too
        views_first = scene.packing is not None
        fov_deg_BV = cameras.fov_deg_BV.T if views_first else cameras.fov_deg_BV
        rays_BVQC = bundle_rays(ray_directions(fov_deg_BV, resolution), self.patch_px)
        with without_autocast(rays_BVQC.device):
            x_BVQW = self.token_W + self.rays_norm(self.rays(rays_BVQC))
        rotation = camera_rotation(self.rotary, scene.places, cameras.c2w_BV44)
        if scene.packing is not None:
            rotation = packed_camera_rotation(rotation, scene.packing)
        cuts: list[Windows | None] = [None, None]
        if width := self.window_bundles:
            side = resolution // self.patch_px
            device = x_BVQW.device
            cuts = [cut_windows(side, width, shifted=each, device=device) for each in (False, True)]
        x_BVQW = x_BVQW.to(dtype_of(self.layers))
        keys = scene.keys(views=rotation[0].shape[1])
        taps = {}
        for index, (layer, (k, v)) in enumerate(zip(self.layers, scene.keys_values, strict=True)):
            inputs = x_BVQW, (k, v), rotation, keys, cuts[index % 2]
            x_BVQW = run_layer(layer, *inputs, recompute=self.recompute)
            if index in self.head.taps:
                taps[index] = x_BVQW
        weights = rounded_weights(self.head, x_BVQW.device, self.head.rounded_parts)
        tokens = [torch.flatten(taps[tap], 0, 1) for tap in self.head.taps]
        picture_MCRR = rounded_call(self.head, weights, tokens)
        picture_BVRRC = picture_MCRR.movedim(1, -1).unflatten(0, fov_deg_BV.shape)
        return picture_BVRRC.transpose(0, 1) if views_first else picture_BVRRC
