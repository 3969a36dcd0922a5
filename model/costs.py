"""Costs of a network from its configuration: parameters, FLOPs, bytes.

FLOPs are counted by torch's FlopCounterMode on the meta device, where tensors have shapes and no
numbers: matrix products, attention and convolutions, with two for a multiplication and an addition.
Norms, rotations and activations are left out (1 % of the time at 205 M parameters).
"""

import functools
import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch.utils.flop_counter import FlopCounterMode

from model.config import BundleStage, ModelConfig
from model.hits.traced import INPUTS, Traced
from model.hits.view_inputs import NUM_CHANNELS
from model.precision import PRECISIONS, rounded_parts
from model.renderformer import SIDE_LIGHTS, RenderFormer, count_parameters
from model.scene_tensors import SceneBatch
from storage.records.material import material_width

TRAINING_BYTES = 16
"""Bytes per parameter while training in float32: weight, gradient, and AdamW's two moments."""


TRAINING_PASSES = 3
"""Forward passes of equal cost in a training step: backward has a product for each operand."""

OTHER_WORK = "keys, values and what reads them"
"""Part of the work that is done outside of the modules that are parts themselves."""

_PART = re.compile(r"RenderFormer\.(\w+)\.(?:(layers)\.\d+\.)?(\w+)")


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
    with torch.device("meta"), torch.no_grad(), FlopCounterMode(display=False) as counter:
        RenderFormer(config)(_meta_batch(config, workload), workload.resolution)
    parts = Counter[str]()
    for name, counts in counter.get_flop_counts().items():
        if match := _PART.fullmatch(name):
            parts[f"{match[1]} {match[3]}"] += sum(counts.values())
    parts[OTHER_WORK] = counter.get_total_flops() - parts.total()
    return {name: count for name, count in parts.items() if count}


def _meta_batch(config: ModelConfig, workload: Workload) -> SceneBatch:
    """Return a scene on the meta device, with its traced inputs, as the network reads it."""
    t = workload.triangles
    v = workload.views
    r = workload.resolution
    stage = config.stage
    traced = albedo = None
    if isinstance(stage, BundleStage):
        albedo = torch.zeros(1, v, r, r, 6) if config.demodulated else None
    else:
        anchors = math.gcd(stage.hit_anchors, r) ** 2
        traced = Traced(
            sides_T12=torch.zeros(1, t, SIDE_LIGHTS),
            unit_3=torch.zeros(1, 3),
            pixels_VRRC=torch.zeros(1, v, r, r, NUM_CHANNELS),
            anchor_VA=torch.zeros(1, v, anchors, dtype=torch.long),
            gathered_VA3=torch.zeros(1, v, anchors, 3),
            given_VI=torch.zeros(1, v, len(INPUTS)),
        )
    return SceneBatch(
        triangles_BT33=torch.zeros(1, t, 3, 3),
        normals_BT33=torch.zeros(1, t, 3, 3),
        material_BTM=torch.zeros(1, t, material_width(config.material_columns)),
        c2w_BV44=torch.zeros(1, v, 4, 4),
        fov_deg_BV=torch.zeros(1, v),
        is_triangle_BT=None,
        columns=config.material_columns,
        traced=traced,
        albedo_BVRR6=albedo,
    )


@functools.lru_cache
def training_flops(config: ModelConfig, views: int, resolution: int) -> Callable[[int], int]:
    """Return the FLOPs of a forward and backward pass as a function of a scene's triangles.

    Attention is quadratic in them, so that three counts tell all. Torch counts by hooks of all
    modules: no other thread may run any until this returns.
    """
    at_0, at_1, at_2 = (
        sum(flops(config, Workload(triangles=n, views=views, resolution=resolution)).values())
        for n in range(3)
    )
    quadratic = (at_0 - 2 * at_1 + at_2) // 2
    linear = at_1 - at_0 - quadratic
    return lambda n: TRAINING_PASSES * (at_0 + n * (linear + n * quadratic))
