"""Demodulated pictures: the network predicts light, and traced visible surfaces reflect it.

    radiance = diffuse albedo * diffuse light + specular albedo * specular light

The albedo of a pixel's visible surface is computed exactly in milliseconds: its rays are traced to
the first triangle that is no lamp, and two material columns are averaged over them, 0 for misses.
So color textures, silhouettes and the black background need not be learned. Diffuse light is
irradiance over pi; neither light is ever negative, and the network predicts both as log10(1 + x).
Glossy reflection has no exact factor: its light contains a blurred mirror image.
"""

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from model.hits.anchors import Rays
from model.hits.lit_scene import LitScene
from model.precision import without_autocast
from model.scene_tensors import Cameras

_START = -1.5
"""Offset before softplus: the initial light of 0.6 in every pixel is about that of the scenes."""

_BRIGHTEST = 8.0
"""Maximum log10(1 + light): far above any lamp, and small enough for float32."""


def compose_radiance(light_BVRR6: Tensor, albedo_BVRR6: Tensor) -> Tensor:
    """Return log10(1 + radiance) [B, V, R, R, 3], at least 0, from predicted light and albedo.

    Args:
        light_BVRR6: output of a head; diffuse, then specular.
        albedo_BVRR6: albedo in the same order.
    """
    with without_autocast(light_BVRR6.device):
        log10_BVRR6 = softplus(light_BVRR6 + _START).clamp(max=_BRIGHTEST)
        reflected = albedo_BVRR6 * torch.expm1(log10_BVRR6 * math.log(10))
        return torch.log1p(reflected[..., :3] + reflected[..., 3:]) / math.log(10)


def albedo_of_cameras(
    scenes: tuple[LitScene, ...], cameras: Cameras, resolution: int, rays_a_side: int
) -> Tensor:
    """Return the albedo [B, V, R, R, 6] that cameras of a batch see, float32 on the CPU."""
    albedo = [
        albedo_of_views(scene, c2w_V44, fov_deg_V, resolution, rays_a_side)
        for scene, c2w_V44, fov_deg_V in zip(
            scenes, cameras.c2w_BV44, cameras.fov_deg_BV, strict=True
        )
    ]
    return torch.stack(albedo)


def albedo_of_views(
    scene: LitScene, c2w_V44: Tensor, fov_deg_V: Tensor, resolution: int, rays_a_side: int
) -> Tensor:
    """Return the diffuse and specular albedo [V, R, R, 6] of visible surfaces.

    Each pixel is the mean over its rays_a_side^2 rays; a miss counts as black.
    """
    nothing = np.zeros((6, 1), np.float32)  # the last column, which a miss picks
    table = np.concatenate([np.concatenate([scene.diffuse, scene.specular]), nothing], axis=1)
    views = []
    for c2w_44, fov_deg in zip(c2w_V44.detach().cpu().numpy(), fov_deg_V, strict=True):
        rays = Rays(c2w_44, float(fov_deg), resolution, rays_a_side)
        total = np.zeros((6, resolution**2), np.float32)
        for jitter in range(rays.rays_per_pixel):
            total += table[:, scene.first_hits(rays.origin, rays.direction(jitter)).triangle]
        views.append(total.T / np.float32(rays.rays_per_pixel))
    return torch.from_numpy(np.stack(views)).unflatten(1, (resolution, resolution))
