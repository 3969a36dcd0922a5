"""Costs of a network from its configuration: parameters, FLOPs, bytes.

A multiplication and an addition count as two. Matrix products, attention and convolutions are
counted as by torch's FlopCounterMode, against which this is tested; norms, rotations and
activations are left out (1 % of the time at 205 M parameters).

    d width   f hidden width   n registers + triangles   q ray bundles of a view
"""

import functools
from dataclasses import dataclass

import torch

from model.attention import cut_windows
from model.config import ModelConfig
from model.hits.decoder import view_flops
from model.positions import encoded_normal_width
from model.precision import PRECISIONS, rounded_parts
from model.renderformer import SIDE_LIGHTS, RenderFormer, count_parameters
from model.view_decoder import LAST_CHANNELS, picture_channels
from storage.records.material import material_width

TRAINING_BYTES = 16
"""Bytes per parameter while training in float32: weight, gradient, and AdamW's two moments."""


TRAINING_PASSES = 3
"""Forward passes of equal cost in a training step: backward has a product for each operand."""


@dataclass(frozen=True, kw_only=True)
class Workload:
    """Size of a scene and its views."""

    triangles: int
    """Number of triangles in the scene."""
    views: int
    """Number of views of that scene."""
    resolution: int
    """Width of each view in pixels."""


@dataclass(frozen=True, kw_only=True)
class Costs:
    """Costs of a network and of a workload."""

    parameters: dict[str, int]
    """Numbers in the weights, by part of the network."""
    flops: dict[str, int]
    """FLOPs of the whole workload, by part of the computation."""
    weight_bytes: dict[str, int]
    """Bytes of the weights, by precision."""
    scene_bytes: dict[str, int]
    """Bytes of the cached keys and values of an encoded scene, by precision."""
    training_bytes: int
    """Bytes of weights, gradients and AdamW's moments in float32, without activations."""


def costs(config: ModelConfig, workload: Workload) -> Costs:
    """Return the costs of a configuration without allocating weights."""
    with torch.device("meta"):
        model = RenderFormer(config)
    rounded = sum(count_parameters(part) for part in rounded_parts(model))
    total = count_parameters(model)
    head = count_parameters(model.decoder.head)
    tokens = config.num_registers + workload.triangles
    cached_numbers = 2 * config.decoder_layers * tokens * config.width
    sizes = {name: precision.dtype.itemsize for name, precision in PRECISIONS.items()}
    return Costs(
        parameters={
            "triangle encoder": 0 if model.encoder is None else count_parameters(model.encoder),
            "view decoder": count_parameters(model.decoder) - head,
            f"{config.head} head": head,
        },
        flops=flops(config, workload),
        weight_bytes={name: size * rounded + 4 * (total - rounded) for name, size in sizes.items()},
        scene_bytes={name: size * cached_numbers for name, size in sizes.items()},
        training_bytes=TRAINING_BYTES * total,
    )


def flops(config: ModelConfig, workload: Workload) -> dict[str, int]:
    """Return the FLOPs of each part of a forward pass."""
    d = config.width
    f = config.hidden_width
    n = config.num_registers + workload.triangles
    per_side = workload.resolution // config.patch_px
    q = per_side**2
    views = workload.views
    token_inputs = material_width(config.material_columns) + encoded_normal_width(
        config.normal_octaves
    )
    if config.traces_hits:
        token_inputs += SIDE_LIGHTS
    stage = {
        "triangle tokens": 2 * workload.triangles * token_inputs * d,
        "triangle self-attention": config.encoder_layers * (8 * n * d * d + 4 * n * n * d),
        "triangle feed-forward": config.encoder_layers * 6 * n * d * f,
        "keys and values": config.decoder_layers * 4 * n * d * d,
    }
    if config.traces_hits:
        view = view_flops(config, n, workload.resolution)
        scene_stage = stage if config.scene_tokens else {}
        return scene_stage | {name: views * count for name, count in view.items()}
    layers = {
        "cross-attention": 4 * q * d * d + 4 * q * n * d,
        "bundle self-attention": 8 * q * d * d + 4 * d * _pairs(config, per_side),
        "view feed-forward": 6 * q * d * f,
    }
    return {
        **stage,
        "bundle tokens": views * 2 * q * 3 * config.patch_px**2 * d,
        **{name: views * config.decoder_layers * count for name, count in layers.items()},
        "head": views * _head(config, per_side),
    }


@functools.lru_cache(maxsize=4096)
def training_flops(config: ModelConfig, workload: Workload) -> int:
    """Return the FLOPs of a forward and backward pass: each product has two more backward."""
    return TRAINING_PASSES * sum(flops(config, workload).values())


@functools.lru_cache
def _pairs(config: ModelConfig, per_side: int) -> int:
    """Return the number of (query, key) pairs of bundles, as a mean over the layers."""
    if not config.window_bundles:
        return per_side**4
    cuts = [
        cut_windows(per_side, config.window_bundles, shifted=each, device=torch.device("cpu"))
        for each in (False, True)
    ]
    pairs = [sum(count * size**2 for count, size in cut.groups) for cut in cuts]
    layers = config.decoder_layers
    return sum(pairs[layer % 2] for layer in range(layers)) // layers


def _head(config: ModelConfig, per_side: int) -> int:
    if config.head == "linear":
        return 2 * per_side**2 * config.width * picture_channels(config) * config.patch_px**2
    features = config.dpt_features
    half = (per_side + 1) // 2
    grids = (4 * per_side, 2 * per_side, per_side, half)
    total = 0
    for level, (wide, side) in enumerate(zip(config.dpt_channels, grids, strict=True)):
        resize = (16, 4, 0, 9)[level] * wide * wide * (half if level == 3 else per_side) ** 2
        blocks = 1 if level == 3 else 2
        refine = (9 * wide * features + blocks * 2 * 9 * features**2) * side**2
        total += config.width * wide * per_side**2 + resize + refine + features**2 * side**2
    full = (8 * per_side) ** 2
    halve = 9 * features * (features // 2) * full
    last = (9 * (features // 2) * LAST_CHANNELS + picture_channels(config) * LAST_CHANNELS) * full
    return 2 * (total + halve + last)
