"""Tiny networks with awake heads, random scenes for them, and attention in plain lines."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from model.config import ModelConfig
from model.renderformer import RenderFormer
from model.scene_tensors import SceneBatch, SceneTensors, batch_scenes

RESOLUTION = 32

FAMILIES = ["linear", "dpt", "swin"]
"""Kinds of tiny_config: a linear head, V1-Base's parts, V1.1-Large's parts."""


def tiny_config(head: str = "linear", **changes: object) -> ModelConfig:
    config = ModelConfig(
        width=48,
        num_heads=2,
        encoder_layers=2,
        decoder_layers=2,
        hidden_width=32,
        num_registers=2,
        rope_num_freqs=1,
        rope_max_freq=5.0,
        head="linear",
    )
    if head == "dpt":
        dpt = {"dpt_features": 4, "dpt_channels": (4, 6, 4, 8), "dpt_taps": (0, 1, 0, 1)}
        config = dataclasses.replace(config, head="dpt", **dpt)  # type: ignore[arg-type]
    if head == "swin":
        config = dataclasses.replace(tiny_config("dpt"), window_bundles=2)
    return dataclasses.replace(config, **changes)  # type: ignore[arg-type]


def awake(config: ModelConfig, dtype: torch.dtype = torch.float64, seed: int = 0) -> RenderFormer:
    """Return a network none of whose parts is zero or one: it stands for a trained one."""
    generator = torch.Generator().manual_seed(seed)
    model = RenderFormer(config)
    model.initialize(generator)
    for module in model.modules():
        if isinstance(module, nn.RMSNorm):
            assert module.weight is not None
            nn.init.uniform_(module.weight, 0.7, 1.3, generator=generator)
        elif isinstance(module, nn.Linear | nn.Conv2d | nn.ConvTranspose2d):
            if module.bias is not None:
                nn.init.normal_(module.bias, std=0.1, generator=generator)
    nn.init.normal_(model.decoder.head.last.weight, std=0.2, generator=generator)
    return model.to(dtype).eval()


def random_pose(generator: torch.Generator) -> Tensor:
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation * torch.det(rotation).sign()
    pose[:3, 3] = 2 * torch.randn(3, generator=generator, dtype=torch.float64)
    return pose


def random_scene(
    num_triangles: int, num_views: int = 2, seed: int = 0, dtype: torch.dtype = torch.float64
) -> SceneTensors:
    generator = torch.Generator().manual_seed(seed)
    normals = torch.randn(num_triangles, 3, 3, generator=generator, dtype=torch.float64)
    poses = torch.stack([random_pose(generator) for _ in range(num_views)])
    fov_deg = torch.rand(num_views, generator=generator, dtype=torch.float64)
    return SceneTensors(
        triangles_T33=torch.randn(num_triangles, 3, 3, generator=generator).to(dtype),
        normals_T33=(normals / normals.norm(dim=-1, keepdim=True)).to(dtype),
        material_TM=torch.rand(num_triangles, 10, generator=generator).to(dtype),
        c2w_V44=poses.to(dtype),
        fov_deg_V=(30 + 30 * fov_deg).to(dtype),
    )


def tensors_of(scenes: SceneTensors) -> dict[str, Tensor]:
    return {name: value for name, value in vars(scenes).items() if isinstance(value, Tensor)}


def render(model: RenderFormer, *scenes: SceneTensors, resolution: int = RESOLUTION) -> Tensor:
    with torch.no_grad():
        pictures: Tensor = model(batch_scenes(scenes), resolution)
    return pictures


def picture_and_gradients(
    model: RenderFormer, batch: SceneBatch, resolution: int = RESOLUTION
) -> dict[str, Tensor]:
    """Return a picture, and what its square teaches each weight that it reaches."""
    model.zero_grad()
    picture = model(batch, resolution)
    picture.square().sum().backward()
    weights = {name: weight.grad for name, weight in model.named_parameters()}
    return {"picture": picture.detach(), **{k: v for k, v in weights.items() if v is not None}}


def value_and_gradients(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], upstream: Tensor, *rest: Any
) -> list[Tensor]:
    fresh = [each.clone().requires_grad_() for each in inputs]
    value = function(*fresh, *rest)
    return [value.detach(), *torch.autograd.grad(value, fresh, upstream)]


def attend_reference(
    q_BHQD: Tensor, k_BHND: Tensor, v_BHND: Tensor, is_key_BN: Tensor | None
) -> Tensor:
    """Return what `attend` returns, scene by scene, slowly, on the keys that exist alone."""
    pictures = []
    for scene in range(len(q_BHQD)):
        keys_HND, values_HND = k_BHND[scene], v_BHND[scene]
        if is_key_BN is not None:
            keys_HND = keys_HND[:, is_key_BN[scene]]
            values_HND = values_HND[:, is_key_BN[scene]]
        scores_HQN = q_BHQD[scene] @ keys_HND.transpose(-1, -2) / math.sqrt(keys_HND.shape[-1])
        weights_HQN = scores_HQN.exp() / scores_HQN.exp().sum(dim=-1, keepdim=True)
        pictures.append(weights_HQN @ values_HND)
    return torch.stack(pictures)


def hits_config(**changes: Any) -> ModelConfig:
    config = tiny_config(
        encoder_layers=1,
        view_stage="hits",
        hit_rays=2,
        hit_anchors=8,
        gather_rays=16,
        pixel_width=16,
        filter_width=8,
    )
    return dataclasses.replace(config, **changes)


def publishable(family: str) -> ModelConfig:
    """Return a tiny configuration of a published family."""
    wide = {"width": 144, "num_heads": 2, "rope_num_freqs": 3}
    if family == "dpt":
        return tiny_config("dpt", **wide, rope_max_freq=2.0, register_eps=1e-5)
    return tiny_config("swin", **wide, rope_max_freq=5.0, window_bundles=8, register_eps=1e-5)
