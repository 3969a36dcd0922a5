"""The published V1-Base forward pass, written from the description of its operations.

What we are measured against. It does what is published and no more: float32, fused attention, the
whole 13 x P x P texture of every triangle through its encoder, every scene padded to one length
with a mask over the keys, all views of a scene together, the context's keys and values anew for
each of them, the picture head in torch's usual layout. Weights stay under their published names.
Full attention only, no windows.

Suffixes as in model.scene_tensors; C texture values of a triangle.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import (
    conv2d,
    conv_transpose2d,
    elu,
    interpolate,
    linear,
    pad,
    rms_norm,
    scaled_dot_product_attention,
    silu,
)

from model.config import ModelConfig
from model.published.config import PublishedConfig
from model.published.convert import NORMAL
from model.rays import bundle_rays, ray_directions
from model.scene_tensors import SceneTensors

Weights = Mapping[str, Tensor]
"""Tensors under their published names."""

_HEAD = "view_transformer.out_dpt"
_ELU_ALPHA = 1e-3
_LAYER_EPS, _TOKEN_EPS, _REGISTER_EPS = 1e-6, 1.1920929e-07, 1e-5
_VIEW = "view_transformer"

Rotation = tuple[Tensor, Tensor]
"""cos and sin [V, 1, N, D / 2]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedInputs:
    """One scene as the published network reads it; a batch of one, float32."""

    triangles_T33: Tensor
    """Vertices, zero in the padding."""
    normals_T33: Tensor
    """Vertex normals, zero in the padding."""
    texture_TC: Tensor
    """13 P P values of each triangle; emission as log10(1 + emission)."""
    exists_T: Tensor
    """bool, False in the padding."""
    c2w_V44: Tensor
    """Cameras to world."""
    fov_deg_V: Tensor
    """Full fields of view."""


def published_inputs(scene: SceneTensors, *, padded: int, texture_patch: int) -> PublishedInputs:
    """Return a scene padded to `padded` triangles, its materials spread over their textures."""
    ten = scene.material_TM
    normal = ten.new_tensor([0.5, 0.5, 1.0]).expand(len(ten), 3)
    thirteen = torch.cat([ten[:, : NORMAL.start], normal, ten[:, NORMAL.start :]], dim=1)
    place = torch.arange(texture_patch, device=ten.device)
    filled = (place[:, None] + place <= texture_patch).to(ten.dtype)
    texture = (thirteen[:, :, None, None] * filled).flatten(1)
    missing = padded - scene.num_triangles
    exists = torch.ones(scene.num_triangles, dtype=torch.bool, device=ten.device)
    return PublishedInputs(
        triangles_T33=pad(scene.triangles_T33, (0, 0, 0, 0, 0, missing)),
        normals_T33=pad(scene.normals_T33, (0, 0, 0, 0, 0, missing)),
        texture_TC=pad(texture, (0, 0, 0, missing)),
        exists_T=pad(exists, (0, missing)),
        c2w_V44=scene.c2w_V44,
        fov_deg_V=scene.fov_deg_V,
    )


def published_forward(
    weights: Mapping[str, Tensor], config: PublishedConfig, inputs: PublishedInputs, resolution: int
) -> Tensor:
    """Return log10(1 + radiance) [V, R, R, 3], behind the ELU.

    Args:
        weights: under published names, as `model.published.convert.to_published`.
        config: of V1-Base's family.
        inputs: the scene.
        resolution: a multiple of the width of a bundle.
    """
    model = config.model
    num_registers = model.num_registers
    is_key = pad(inputs.exists_T, (num_registers, 0), value=True)[None, None, None]
    x_1NW = _tokens(weights, inputs, model.normal_octaves)
    rotation = _rotation(weights, _places(inputs.triangles_T33[None], inputs, num_registers), model)
    for layer in range(model.encoder_layers):
        name = f"transformer.layers.{layer}"
        normed = _norm(weights, f"{name}.query_norm", x_1NW)
        x_1NW = x_1NW + _attend_self(
            weights, f"{name}.multihead_attn", normed, rotation, is_key, model.num_heads
        )
        x_1NW = x_1NW + _feed_forward(weights, name, x_1NW)
    return _view_stage(weights, config, inputs, x_1NW, is_key, resolution)


def _view_stage(
    weights: Weights,
    config: PublishedConfig,
    inputs: PublishedInputs,
    context_1NW: Tensor,
    is_key: Tensor,
    resolution: int,
) -> Tensor:
    model, views = config.model, len(inputs.c2w_V44)
    context_VNW = context_1NW.repeat(views, 1, 1)
    c2w = inputs.c2w_V44
    in_camera = (inputs.triangles_T33 - c2w[:, None, None, :3, 3]) @ c2w[:, None, :3, :3]
    rotation = _rotation(weights, _places(in_camera, inputs, model.num_registers), model)
    rays = bundle_rays(ray_directions(inputs.fov_deg_V, resolution), model.patch_px)
    encoded = linear(rays, *_pair(weights, f"{_VIEW}.ray_map_encoder"))
    x_VQW = _norm(weights, f"{_VIEW}.ray_map_encoder_norm", encoded, _TOKEN_EPS)
    x_VQW = x_VQW + weights[f"{_VIEW}.ray_map_patch_token"]
    at_origin = _rotation(weights, x_VQW.new_zeros((*x_VQW.shape[:2], 3, 3)), model)
    outputs = []
    for layer in range(model.decoder_layers):
        name = f"{_VIEW}.transformer.layers.{layer}"
        x_VQW = x_VQW + _attend_context(
            weights, name, x_VQW, context_VNW, (at_origin, rotation), is_key, model.num_heads
        )
        normed = _norm(weights, f"{name}.self_attn_norm", x_VQW)
        x_VQW = x_VQW + _attend_self(
            weights, f"{name}.self_attn", normed, at_origin, None, model.num_heads
        )
        x_VQW = x_VQW + _feed_forward(weights, name, x_VQW)
        outputs.append(x_VQW)
    return _published_head(weights, [outputs[tap] for tap in model.dpt_taps])


def _tokens(weights: Weights, inputs: PublishedInputs, octaves: int) -> Tensor:
    """Return registers and triangles [1, N, W]."""
    texture = linear(inputs.texture_TC, *_pair(weights, "texture_encoder"))
    nine = inputs.normals_T33.flatten(1)
    scaled = (nine[..., None] * 2.0 ** torch.arange(octaves, device=nine.device)).flatten(1)
    encoded = torch.cat([nine, scaled.sin(), (scaled + math.pi / 2).sin()], dim=1)
    normal = linear(encoded, *_pair(weights, "vn_encoding_proj"))
    triangles_1TW = (
        weights["tri_token"]
        + _norm(weights, "texture_encoder_norm", texture, _TOKEN_EPS)
        + _norm(weights, "vn_encoder_norm", normal, _TOKEN_EPS)
    )
    return torch.cat([weights["reg_tokens"], triangles_1TW], dim=1)


def _places(triangles_VT33: Tensor, inputs: PublishedInputs, num_registers: int) -> Tensor:
    """Return where tokens stand [V, N, 3, 3]: registers at the mean of all vertices."""
    exists = inputs.exists_T[:, None, None].to(triangles_VT33.dtype)
    mean_V33 = (triangles_VT33 * exists).sum(dim=1) / (exists.sum() + _REGISTER_EPS)
    register_V133 = mean_V33.mean(dim=1)[:, None, None].expand(-1, num_registers, 3, 3)
    return torch.cat([register_V133, triangles_VT33], dim=1)


def _rotation(weights: Weights, places_VN33: Tensor, model: ModelConfig) -> Rotation:
    freqs_F = weights["transformer.rope_emb.freqs"]
    angles = (places_VN33.flatten(-2)[..., None] * freqs_F).flatten(-2)
    half = model.head_width // 2
    angles_V1NA = pad(angles, (0, half - angles.shape[-1]))[:, None]
    return angles_V1NA.cos(), angles_V1NA.sin()


def _attend_self(
    weights: Weights,
    name: str,
    x_VNW: Tensor,
    rotation: Rotation,
    is_key: Tensor | None,
    num_heads: int,
) -> Tensor:
    q, k, v = linear(x_VNW, weights[f"{name}.in_proj.weight"]).chunk(3, dim=-1)
    return _attend(weights, name, (q, k, v), (rotation, rotation), is_key, num_heads)


def _attend_context(
    weights: Weights,
    layer: str,
    x_VQW: Tensor,
    context_VNW: Tensor,
    rotations: tuple[Rotation, Rotation],
    is_key: Tensor,
    num_heads: int,
) -> Tensor:
    name = f"{layer}.multihead_attn"
    normed = _norm(weights, f"{layer}.kv_norm", context_VNW)
    q = linear(_norm(weights, f"{layer}.query_norm", x_VQW), weights[f"{name}.q_proj.weight"])
    k, v = (linear(normed, weights[f"{name}.{kind}_proj.weight"]) for kind in "kv")
    return _attend(weights, name, (q, k, v), rotations, is_key, num_heads)


def _attend(
    weights: Weights,
    name: str,
    qkv: tuple[Tensor, Tensor, Tensor],
    rotations: tuple[Rotation, Rotation],
    is_key: Tensor | None,
    num_heads: int,
) -> Tensor:
    q = _norm(weights, f"{name}.q_norm", qkv[0])
    k = _norm(weights, f"{name}.k_norm", qkv[1])
    q, k, v = (x.unflatten(-1, (num_heads, -1)).transpose(1, 2) for x in (q, k, qkv[2]))
    q, k = (_rotate(x, *rotation) for x, rotation in zip((q, k), rotations, strict=True))
    attended = scaled_dot_product_attention(q, k, v, attn_mask=is_key)
    return linear(attended.transpose(1, 2).flatten(2), weights[f"{name}.out_proj.weight"])


def _rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    a, b = x.chunk(2, dim=-1)
    return torch.cat([a * cos - b * sin, b * cos + a * sin], dim=-1)


def _feed_forward(weights: Weights, layer: str, x: Tensor) -> Tensor:
    w1, w2, w3 = (weights[f"{layer}.ffn.w{number}.weight"] for number in (1, 2, 3))
    normed = _norm(weights, f"{layer}.ffn_norm", x)
    return linear(silu(linear(normed, w1)) * linear(normed, w3), w2)


def _norm(weights: Weights, name: str, x: Tensor, eps: float = _LAYER_EPS) -> Tensor:
    return rms_norm(x, x.shape[-1:], weights[f"{name}.weight"], eps)


def _pair(weights: Weights, name: str) -> tuple[Tensor, Tensor]:
    return weights[f"{name}.weight"], weights[f"{name}.bias"]


def _published_head(weights: Weights, taps_VQW: Sequence[Tensor]) -> Tensor:
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
