"""The view stage `hits`: a network reads what each pixel's rays found, and adds the rest.

A grid of anchors asks the scene's tokens, in world space, so that keys are rotated once a scene.
Each pixel mixes what the nine nearest anchors know, by what it is like them, and a small network
says how much of each light that was traced counts, and what is missing:

    radiance = diffuse albedo * (gain * mixed gathered light + irradiance)
             + specular albedo * radiance + gain * direct light + gain * filtered mirrored light

Nothing of it is negative. All light is in units of the scene's mean light, by color: the picture
scales with the lamps exactly. There are no pixels from elsewhere in it, so any width will do.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, normalize, pad, silu, softplus

from model.attention import Keys, Packing, attend
from model.config import ModelConfig
from model.hits.anchors import DEVICE_BLOCK
from model.hits.traced import INPUTS, Traced
from model.hits.view_inputs import Channel
from model.layers import (
    LAYER_NORM_EPS,
    CrossAttention,
    Norm,
    SwiGLU,
    dtype_of,
    merge_heads,
    run_layer,
    split_heads,
)
from model.positions import (
    EncodedScene,
    KeysValues,
    Rotation,
    TokenPositions,
    TriangleRotary,
    packed_rotation,
    rotate,
    world_rotation,
)
from model.precision import fast_float32_products, without_autocast

STEPS_PX = (1, 2, 4, 8)
"""Pixels between those that a level mixes."""

TAPS = 9
"""Pixels that a level mixes for each: three by three."""

_ALIKE = 8
"""Numbers by which pixels are alike."""

_AROUND_PX = (3, 7)
"""Widths of the squares whose mean light is a feature of each pixel."""

_DARKEST = 1e-4
"""Specular albedo that a mixture is divided by at least."""

_ROWS = 32
"""Rows of a picture that are mixed at a time while rendering: they stay in the CPU's cache.
"""

_MOST_DOUBT = 30.0
"""A ray that is not trusted at all counts e^-30: its pixel, all alone, still shows it."""


def filter_flops(num_features: int, width: int, pixels: int) -> int:
    """Return the FLOPs of filtering a picture of so many pixels."""
    first = (num_features + 3 * len(_AROUND_PX)) * width + width * width
    level = 3 * width + width * (_ALIKE + 1) + TAPS * (_ALIKE + 6)
    return 2 * pixels * (first + len(STEPS_PX) * level)


class LightFilter(nn.Module):
    """Features of pixels and their mirrored light -> mirrored light with less noise.

    The weights are learned, never the light itself. One ray of a pixel says what its glossy surface
    shows, with much noise. Pixels that see like things may share what their rays found: each level
    mixes three by three pixels, as far apart as the level says (a trous: Dammertz et al. 2010), by
    how alike the network finds them and how far it trusts each ray. Light is divided by specular
    albedo before, and multiplied after, so that patterns stay sharp; weights have no color, so that
    the picture stays linear in the light.
    """

    def __init__(self, num_features: int, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(num_features + 3 * len(_AROUND_PX), width)
        self.second = nn.Linear(width, width)
        self.light = nn.ModuleList(nn.Linear(3, width) for _ in STEPS_PX)
        self.alike = nn.ModuleList(nn.Linear(width, _ALIKE + 1) for _ in STEPS_PX)
        self.near = nn.Parameter(torch.zeros(len(STEPS_PX), TAPS))

    def forward(self, features_VRRF: Tensor, light_VRR3: Tensor, albedo_VRR3: Tensor) -> Tensor:
        """Return the mixed light [V, R, R, 3], of at least 0; linear in `light` for equal weights.

        Args:
            features_VRRF: features of each pixel.
            light_VRR3: what its ray brought, in units of the scene's light.
            albedo_VRR3: the specular albedo that it was multiplied by.
        """
        both = torch.cat([light_VRR3, albedo_VRR3], dim=-1).movedim(-1, 1)
        around = [_log_light(_mean_around(both, width)) for width in _AROUND_PX]
        known_VRRW = self.second(silu(self.first(torch.cat([features_VRRF, *around], dim=-1))))
        levels = zip(STEPS_PX, self.light, self.alike, self.near, strict=True)
        for step, light, alike, near in levels:
            at_level = silu(known_VRRW + light(_log_light(both)))
            both = self.mix_level(alike(at_level).movedim(-1, 1), near, both, step)
        return _without_albedo(both).movedim(1, -1) * albedo_VRR3

    @staticmethod
    def mix_level(alike_VCRR: Tensor, near_9: Tensor, both_V6RR: Tensor, step: int) -> Tensor:
        """Return one level's light and albedo [V, 6, R, R], mixed with the same weights.

        It is a hundred kernels, or one compiled.
        """
        height = both_V6RR.shape[2]
        frame = (step, step, step, step)
        trust = torch.exp(-softplus(-alike_VCRR[:, _ALIKE:]).clamp(max=_MOST_DOUBT))
        around = pad(torch.cat([alike_VCRR[:, :_ALIKE], trust, both_V6RR], dim=1), frame)
        rows = _ROWS if around.device.type == "cpu" and not torch.is_grad_enabled() else height
        return torch.cat(
            [
                _mix_rows(around[:, :, first : first + rows + 2 * step], near_9, step)
                for first in range(0, height, rows)
            ],
            dim=2,
        )


def _without_albedo(both_V6RR: Tensor) -> Tensor:
    return both_V6RR[:, :3] / both_V6RR[:, 3:].clamp(min=_DARKEST)


def _log_light(both_V6RR: Tensor) -> Tensor:
    """Return light without albedo as the network reads it, log(1 + 4 light), [V, R, R, 3]."""
    return torch.log1p(4 * _without_albedo(both_V6RR)).movedim(1, -1)


def _mean_around(both_V6RR: Tensor, width: int) -> Tensor:
    """Return means over squares, by rows and then by columns: a fifth of the time of both at once.

    At the rim only what is inside counts.
    """
    half = width // 2
    rows = avg_pool2d(both_V6RR, (1, width), 1, (0, half), count_include_pad=False)
    return avg_pool2d(rows, (width, 1), 1, (half, 0), count_include_pad=False)


def _mix_rows(around_VCRR: Tensor, near_9: Tensor, step: int) -> Tensor:
    """Return [V, 6, rows, R] from all numbers of pixels with a frame around, 0 outside."""
    height, width = (size - 2 * step for size in around_VCRR.shape[2:])
    center = around_VCRR[:, :_ALIKE, step : step + height, step : step + width]
    total: Tensor | float = 0.0
    shares: Tensor | float = 0.0
    for tap, near in enumerate(near_9):
        row = tap // 3 * step
        column = tap % 3 * step
        neighbor = around_VCRR[:, :, row : row + height, column : column + width]
        unlike = (center - neighbor[:, :_ALIKE]).square().sum(dim=1, keepdim=True)
        share = torch.exp(near - unlike) * neighbor[:, _ALIKE : _ALIKE + 1]
        total = total + share * neighbor[:, _ALIKE + 1 :]
        shares = shares + share
    return cast(Tensor, total / shares)


NEIGHBOURS = 9
"""Anchors that a pixel reads: the anchor of its tile of the picture and its eight neighbors."""

OFFSET_DIM = 6
"""Number of features of a pixel's offset to a mixture of anchors."""

FARTHEST = 30.0
"""Limit of differences: an anchor at the limit has weight 0 unless all anchors are there."""

_NEAREST_M = 1e-3
"""Added to distances, so that a pixel that meets nothing divides by more than 0."""


_SURFACE = 3 + 3 + 3 + 1 + 3 + 3 + 1 + 1 + 1 + 4
"""Number of features of the surfaces that a pixel and its mirrored ray see (`_surface`)."""

_LIGHTS = (
    Channel.OPEN_DIFFUSE,
    Channel.OPEN_SPECULAR,
    Channel.DIRECT_DIFFUSE,
    Channel.DIRECT_SPECULAR,
    Channel.SHOWN_DIFFUSE,
)

PIXEL_DIM = _SURFACE + 3 * (len(_LIGHTS) + 1) + len(INPUTS)
"""Number of features of a pixel; an anchor has three more, its gathered light."""

_START = -3.0
"""First value of the learned light, before softplus: a twentieth of the scene's mean, so that the
first picture is what was traced, with dim shadows."""

_GAINED = 3
"""Lights that are multiplied by a learned gain: gathered, direct, mirrored."""

BLOCK_PIXELS = 2**12
"""Pixels that are computed at a time while rendering."""


def view_flops(config: ModelConfig, tokens: int, resolution: int) -> dict[str, int]:
    """Return the FLOPs of the parts of this stage for one view of a scene of so many tokens."""
    d = config.width
    p = config.pixel_width
    a = math.gcd(config.hit_anchors, resolution) ** 2
    asks = 4 * a * d * d + 4 * a * tokens * d if config.scene_tokens else 0
    pixel = PIXEL_DIM * p + p * p + NEIGHBOURS * (2 * p + 3) + OFFSET_DIM * p + NEIGHBOURS * 4 * 3
    pixel += (2 * p + 3) * 2 * p + 2 * p * p + p * 3 * (_GAINED + 2)
    width = config.filter_width
    return {
        "filter": filter_flops(PIXEL_DIM, width, resolution**2) if width else 0,
        "anchors": 2 * a * ((PIXEL_DIM + 3) * d + d * d),
        "cross-attention": config.decoder_layers * asks,
        "view feed-forward": config.decoder_layers * 6 * a * d * config.hidden_width,
        "head": 4 * a * d * p + 2 * resolution**2 * pixel,
    }


class AnchorLayer(nn.Module):
    """Anchors read the scene, then SwiGLU, each added to the residual stream."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.cross_norm = Norm(config.width, eps=LAYER_NORM_EPS) if config.scene_tokens else None
        self.cross = CrossAttention(config.width, config.num_heads) if config.scene_tokens else None
        self.ffn_norm = Norm(config.width, eps=LAYER_NORM_EPS)
        self.ffn = SwiGLU(config.width, config.hidden_width)

    def forward(
        self,
        x_BVAW: Tensor,
        keys_values: KeysValues | None,
        rotation_BVAD: Rotation,
        keys: Keys,
        reads_BV11: Tensor,
    ) -> Tensor:
        """[B, V, A, W] -> [B, V, A, W].

        Keys are rotated; `reads` is 0 where tokens are withheld.
        """
        cross = self.cross
        if cross is None or self.cross_norm is None or keys_values is None:
            return x_BVAW + self.ffn(self.ffn_norm(x_BVAW))
        q_BVHAD = split_heads(cross.q_norm(cross.q(self.cross_norm(x_BVAW))), cross.num_heads)
        q_BVHAD = rotate(q_BVHAD, *rotation_BVAD)
        views = q_BVHAD.shape[1]
        anchors = q_BVHAD.shape[3]
        # the views of a scene attend to the same keys: together they are one longer row of queries
        q_BHQD = q_BVHAD.movedim(1, 2).flatten(2, 3)
        attended = attend(q_BHQD, *keys_values, keys).unflatten(2, (views, anchors))
        read = cross.out(merge_heads(attended.movedim(2, 1)))
        x_BVAW = x_BVAW + read * reads_BV11.to(read.dtype)
        return x_BVAW + self.ffn(self.ffn_norm(x_BVAW))


class PixelHead(nn.Module):
    """Pixels and the anchors around them -> what is learned of each pixel's light."""

    rounded_parts = ()  # of a precision: steps would show in the sum

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        width = config.pixel_width
        self.told = nn.Linear(PIXEL_DIM, width)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(config.width, width)
        self.value = nn.Linear(config.width, width)
        self.place = nn.Linear(OFFSET_DIM, width)
        self.nearness = nn.Parameter(torch.full((3,), 2.0))
        self.first = nn.Linear(2 * width + 3, 2 * width)
        self.second = nn.Linear(2 * width, width)
        self.last = nn.Linear(width, 3 * (_GAINED + 2))

    def forward(
        self,
        features_MPF: Tensor,
        pixels_MPC: Tensor,
        key_M9W: Tensor,
        value_M9W: Tensor,
        gathered_M93: Tensor,
        anchors_M9C: Tensor,
        window_MP9: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the learned numbers [M, P, 15], and gathered light mixed for the pixels [M, P, 3].

        M parts of the picture have P pixels and nine anchors each; F numbers a pixel. `window` is
        added to how much alike they are. Offsets are fractions of a pixel's distance to the camera.
        """
        center = anchors_M9C[:, NEIGHBOURS // 2, None, Channel.POSITION]
        pixels_MP3 = pixels_MPC[..., Channel.POSITION] - center
        anchors_M93 = anchors_M9C[..., Channel.POSITION] - center
        distance_MP1 = pixels_MPC[..., Channel.DISTANCE] + _NEAREST_M
        normal = normalize(pixels_MPC[..., Channel.NORMAL], dim=-1)
        other = normalize(anchors_M9C[..., Channel.NORMAL], dim=-1)
        # products of matrices, without [M, P, 9, 3]
        squares = pixels_MP3.square().sum(dim=-1, keepdim=True)
        squares = squares + anchors_M93.square().sum(dim=-1)[:, None]
        separation = (squares - 2 * pixels_MP3 @ anchors_M93.mT).clamp(min=0).sqrt()
        above = normal @ anchors_M93.mT - (normal * pixels_MP3).sum(dim=-1, keepdim=True)
        differences = (
            (8 * separation / distance_MP1).clamp(max=FARTHEST),
            (30 * above.abs() / distance_MP1).clamp(max=FARTHEST),
            2 - 2 * normal @ other.mT,
        )
        pixel_MPW = silu(self.told(features_MPF))
        alike_MP9 = self.query(pixel_MPW) @ key_M9W.mT / math.sqrt(key_M9W.shape[-1])
        for weight, unlike_MP9 in zip(softplus(self.nearness), differences, strict=True):
            alike_MP9 = alike_MP9 - weight * unlike_MP9
        share_MP9 = (alike_MP9 + window_MP9).softmax(dim=-1)
        unlike = torch.stack([(share_MP9 * each).sum(dim=-1) for each in differences], dim=-1)
        offset = (share_MP9 @ anchors_M93 - pixels_MP3) / distance_MP1
        known_MPW = share_MP9 @ value_M9W + self.place(torch.cat([unlike, 4 * offset], dim=-1))
        gathered_MP3 = share_MP9 @ gathered_M93
        both = torch.cat([pixel_MPW, known_MPW, torch.log1p(4 * gathered_MP3)], dim=-1)
        return self.last(silu(self.second(silu(self.first(both))))), gathered_MP3


class HitDecoder(nn.Module):
    """Encoded scenes and what was traced of their views -> pictures."""

    def __init__(self, config: ModelConfig, rotary: TriangleRotary) -> None:
        super().__init__()
        self.config = config
        self.rotary = rotary
        self.recompute = False
        self.filter = LightFilter(PIXEL_DIM, config.filter_width) if config.filter_width else None
        self.told = nn.Linear(PIXEL_DIM + 3, config.width)
        self.anchors = nn.Linear(config.width, config.width)
        self.layers = nn.ModuleList(AnchorLayer(config) for _ in range(config.decoder_layers))
        self.norm = Norm(config.width, eps=LAYER_NORM_EPS)
        self.head = PixelHead(config)

    def keys_values(
        self, context_BNW: Tensor, places: TokenPositions, packing: Packing | None = None
    ) -> tuple[KeysValues, ...]:
        """Return each layer's keys and values of a context, keys rotated to world space."""
        rotation_BND = world_rotation(self.rotary, places)
        if packing is not None:
            rotation_BND = packed_rotation(rotation_BND, packing)
        per_layer = []
        for layer in cast(Iterable[Any], self.layers):
            k_BHND, v_BHND = layer.cross.keys_values(context_BNW)
            per_layer.append((rotate(k_BHND, *rotation_BND), v_BHND))
        return tuple(per_layer)

    def forward(self, scene: EncodedScene, traced: Traced) -> Tensor:
        """Return log10(1 + radiance) [B, V, R, R, 3]; each number is at least 0.

        Args:
            scene: B scenes.
            traced: V views of each, as `model.hits.traced.stack_traced` makes them.
        """
        with without_autocast(traced.pixels_VRRC.device):
            unit_B1113 = traced.unit_3[:, None, None, None, :]
            features, mirrored = self._pixel_features(traced, unit_B1113)
            light_BVA3 = torch.log1p(4 * traced.gathered_VA3 / unit_B1113[..., 0, :])
            anchor = torch.cat([_at_anchors(features, traced.anchor_VA), light_BVA3], dim=-1)
            place = _at_anchors(traced.pixels_VRRC, traced.anchor_VA)
        x_BVAW = self._read_scene(scene, traced, anchor, place[..., Channel.POSITION])
        device = traced.pixels_VRRC.device
        trains = torch.is_grad_enabled() and torch.is_autocast_enabled("cuda")
        with without_autocast(device), fast_float32_products(device, enabled=trains):
            return self._pictures(
                traced, features, mirrored, x_BVAW.to(features.dtype), place, unit_B1113
            )

    def _pixel_features(self, traced: Traced, unit_B1113: Tensor) -> tuple[Tensor, Tensor]:
        """Return the features of pixels [B, V, R, R, F], and their mirrored light, filtered."""
        pixels = traced.pixels_VRRC
        surface = _surface(pixels)
        light = torch.cat([pixels[..., channel] / unit_B1113 for channel in _LIGHTS], dim=-1)
        available = traced.given_VI[:, :, None, None, :].expand(*surface.shape[:-1], -1)
        mirrored = pixels[..., Channel.MIRRORED] / unit_B1113

        def stack_features() -> Tensor:
            lights = torch.log1p(4 * torch.cat([light, mirrored], dim=-1))
            return torch.cat([surface, lights, available], dim=-1)

        is_denoised = self.config.denoises(pixels.shape[2])
        if self.filter is not None and not is_denoised:
            albedo = pixels[..., Channel.SPECULAR] * pixels[..., Channel.COVERAGE]
            views = mirrored.shape[:2]
            flat = [each.flatten(0, 1) for each in (stack_features(), mirrored, albedo)]
            mirrored = self.filter(*flat).unflatten(0, views)
        return stack_features(), mirrored

    def _read_scene(
        self, scene: EncodedScene, traced: Traced, anchor_BVAF: Tensor, position_BVA3: Tensor
    ) -> Tensor:
        """Return the anchors [B, V, A, W] after they have read the scene."""
        x_BVAW = self.anchors(silu(self.told(anchor_BVAF))).to(dtype_of(self.layers))
        rotation = self.rotary(position_BVA3[..., None, :].expand(-1, -1, -1, 3, 3))
        reads_BV11 = traced.given_VI[..., INPUTS.index("tokens"), None, None]
        keys = scene.keys()
        known = scene.keys_values or [None] * len(self.layers)
        for layer, keys_values in zip(self.layers, known, strict=True):
            x_BVAW = run_layer(
                layer,
                x_BVAW,
                keys_values,
                rotation,
                keys,
                reads_BV11,
                recompute=self.recompute,
            )
        return self.norm(x_BVAW)

    def _pictures(
        self,
        traced: Traced,
        features: Tensor,
        mirrored: Tensor,
        x_BVAW: Tensor,
        place_BVAC: Tensor,
        unit_B1113: Tensor,
    ) -> Tensor:
        resolution = features.shape[2]
        parts = x_BVAW.shape[2]
        side = round(parts**0.5)
        views = features.shape[:2]
        unit = unit_B1113.expand(*views, parts, 1, 3).flatten(0, 2)
        head = self.head
        gathered = (traced.gathered_VA3 / unit_B1113[..., 0, :]).flatten(0, 1)
        around = [
            _around(each, side)
            for each in (
                head.key(x_BVAW).flatten(0, 1),
                head.value(x_BVAW).flatten(0, 1),
                gathered,
                place_BVAC.flatten(0, 1),
            )
        ]
        pixel_parts = [
            _in_parts(each.flatten(0, 1), side) for each in (features, traced.pixels_VRRC, mirrored)
        ]
        every = [each.flatten(0, 1) for each in (*pixel_parts, *around)]
        meets_M = every[1][..., 0].any(dim=1)
        is_sparse = features.device.type == "cpu" and not torch.is_grad_enabled()
        rows = []
        for block in _blocks(features, parts):
            radiance_MP3 = torch.zeros_like(every[2][block])
            # a graph of a GPU and a gradient need all parts; on a CPU, black ones cost nothing
            some = meets_M[block] if is_sparse else slice(None)
            unit_M13, features_MPF, pixels_MPC, mirrored_MP3, *near = (
                each[block][some] for each in (unit, *every)
            )
            nothing_M19 = torch.where(near[-1][..., 0] > 0, 0.0, -2 * FARTHEST)[:, None]
            step = round(pixels_MPC.shape[1] ** 0.5)
            window_MP9 = nothing_M19 + _log_window(step, unit_M13.device)
            learned, mixed = head(features_MPF, pixels_MPC, *near, window_MP9)
            radiance_MP3[some] = _compose_radiance(
                learned, mixed, mirrored_MP3, pixels_MPC, unit_M13
            )
            rows.append(radiance_MP3)
        pictures = _whole(torch.cat(rows).unflatten(0, (-1, parts)), side)
        log10 = torch.log1p(pictures) / math.log(10)
        return log10.reshape(*views, resolution, resolution, 3)


def _blocks(features: Tensor, parts: int) -> Iterator[slice]:
    """Yield the parts, of all views, that are computed together.

    A GPU computes all at once in training: view by view would launch its kernels for each view.
    A CPU computes one view at a time, whose numbers stay in its cache, and less in rendering.
    """
    count = features.shape[0] * features.shape[1]
    if features.device.type == "cuda" and torch.is_grad_enabled():
        yield slice(0, count * parts)
        return
    step = parts
    if not torch.is_grad_enabled():
        pixels = BLOCK_PIXELS if features.device.type == "cpu" else DEVICE_BLOCK
        step = max(1, pixels * parts // features.shape[2] ** 2)
    for view in range(count):
        for first in range(0, parts, step):
            yield slice(view * parts + first, view * parts + min(first + step, parts))


def _surface(pixels: Tensor) -> Tensor:
    """Return the features of surfaces [..., 23]."""
    normal = nn.functional.normalize(pixels[..., Channel.NORMAL], dim=-1)
    toward = nn.functional.normalize(pixels[..., Channel.TOWARD], dim=-1)
    cosine = (normal * toward).sum(dim=-1, keepdim=True)
    surface = [
        normal,
        toward,
        2 * cosine * normal - toward,
        cosine,
        pixels[..., Channel.DIFFUSE],
        pixels[..., Channel.SPECULAR],
        pixels[..., Channel.ROUGHNESS],
        pixels[..., Channel.COVERAGE],
        torch.log1p(pixels[..., Channel.DISTANCE]),
        pixels[..., Channel.SEEN_ALBEDO],
        pixels[..., Channel.SEEN_NEARNESS],
    ]
    return torch.cat(surface, dim=-1)


def _at_anchors(values: Tensor, anchor_VA: Tensor) -> Tensor:
    """[B, V, R, R, K] -> [B, V, A, K]: the values at the anchors."""
    index = anchor_VA[..., None].expand(-1, -1, -1, values.shape[-1])
    return values.flatten(2, 3).gather(2, index)


def _in_parts(values_VRRK: Tensor, side: int) -> Tensor:
    """[V, R, R, K] -> [V, M, P, K]: the pixels of each part of the picture, row by row."""
    step = values_VRRK.shape[1] // side
    parts = values_VRRK.unflatten(2, (side, step)).unflatten(1, (side, step))
    return parts.transpose(2, 3).flatten(3, 4).flatten(1, 2)


def _whole(values_VMPK: Tensor, side: int) -> Tensor:
    """[V, M, P, K] -> [V, R, R, K]: the inverse of `_in_parts`."""
    step = round(values_VMPK.shape[2] ** 0.5)
    parts = values_VMPK.unflatten(2, (step, step)).unflatten(1, (side, side))
    return parts.transpose(2, 3).flatten(3, 4).flatten(1, 2)


def _around(values_VAK: Tensor, side: int) -> Tensor:
    """[V, A, K] -> [V, A, 9, K]: the anchors of the parts around; at the rim, the nearest ones."""
    grid = torch.arange(side, device=values_VAK.device)
    near = (grid[:, None] + torch.arange(-1, 2, device=grid.device)).clamp(0, side - 1)
    rows = near[:, None, :, None] * side + near[None, :, None, :]
    return values_VAK[:, rows.reshape(side * side, NEIGHBOURS)]


def _log_window(step: int, device: torch.device) -> Tensor:
    """Return the logarithm [P, 9] of the weight of the nine anchors around, for a part's pixels.

    An anchor fades out, row and column apart, over the half part after which it is none of the
    nine: weights that the network was trained with stay as they are in between.
    """
    offset = (torch.arange(step, device=device)[:, None] + 0.5) / step - 0.5
    sides = torch.arange(-1, 2, device=device)
    weight = (1 + 2 * offset * sides).clamp(max=1).log()
    return (weight[:, None, :, None] + weight[:, None]).reshape(step * step, NEIGHBOURS)


def _compose_radiance(
    learned: Tensor, gathered: Tensor, mirrored: Tensor, pixels: Tensor, unit: Tensor
) -> Tensor:
    """Return radiance [..., 3] of at least 0; gathered and mirrored light are in units."""
    gain_gathered, gain_direct, gain_mirrored, diffuse, specular = learned.split(3, dim=-1)
    gains = [2 * torch.sigmoid(gain) for gain in (gain_gathered, gain_direct, gain_mirrored)]
    coverage = pixels[..., Channel.COVERAGE]
    learned_light = pixels[..., Channel.DIFFUSE] * softplus(diffuse + _START)
    learned_light = learned_light + pixels[..., Channel.SPECULAR] * softplus(specular + _START)
    gathered_light = pixels[..., Channel.DIFFUSE] * gains[0] * gathered
    direct = pixels[..., Channel.SHOWN_DIFFUSE] + pixels[..., Channel.DIRECT_SPECULAR]
    indirect = coverage * (learned_light + gathered_light) + gains[2] * mirrored
    return unit * indirect + gains[1] * direct
