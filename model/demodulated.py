"""Demodulated pictures: the network says which light arrives, first hits say what reflects it.

    radiance = diffuse albedo * diffuse light + specular albedo * specular light

The albedo of what a pixel sees first is known exactly, for milliseconds: its rays are followed to
the first triangle that is no lamp, and the two material columns averaged over them, 0 where nothing
is met. So textures of colour, silhouettes and the black background need not be learned. Diffuse
light is irradiance over pi; neither light is ever negative, and both are log10(1 + x) to the
network. What is glossy has no exact factor: its light is what is left of a mirror image.
"""

import dataclasses
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import softplus

from model.hits.camera import Rays
from model.hits.lit_scene import LitScene
from model.hits.tracing import like, lit_scene_of
from model.precision import as_given
from model.scene_tensors import Cameras, SceneTensors

_START = -1.5
"""Before softplus: the light at the start, 0.6 in every pixel, is about that of the scenes."""

_BRIGHTEST = 8.0
"""Most log10(1 + light): far above any lamp, and small enough for float32."""


def composed(light_BVRR6: Tensor, albedo_BVRR6: Tensor) -> Tensor:
    """Return log10(1 + radiance) [B, V, R, R, 3] of what a head says; each number is at least 0.

    Args:
        light_BVRR6: of a head; diffuse, then specular.
        albedo_BVRR6: likewise.
    """
    with as_given(light_BVRR6.device):
        log10_BVRR6 = softplus(light_BVRR6 + _START).clamp(max=_BRIGHTEST)
        reflected = albedo_BVRR6 * torch.expm1(log10_BVRR6 * math.log(10))
        return torch.log1p(reflected[..., :3] + reflected[..., 3:]) / math.log(10)


def with_albedo(scene: SceneTensors, resolution: int, rays_a_side: int) -> SceneTensors:
    """Return a scene with the albedo that its views see: what a trainer's threads do ahead."""
    albedo = _of_views(lit_scene_of(scene), scene.c2w_V44, scene.fov_deg_V, resolution, rays_a_side)
    return dataclasses.replace(scene, albedo_VRR6=like(albedo, scene.c2w_V44))


def albedo_of_cameras(
    scenes: tuple[LitScene, ...], cameras: Cameras, resolution: int, rays_a_side: int
) -> Tensor:
    """Return the albedo [B, V, R, R, 6] that any cameras of the scenes of a batch see.

    It is where the cameras are, and of their type.
    """
    found = [
        _of_views(scene, c2w_V44, fov_deg_V, resolution, rays_a_side)
        for scene, c2w_V44, fov_deg_V in zip(
            scenes, cameras.c2w_BV44, cameras.fov_deg_BV, strict=True
        )
    ]
    return like(torch.stack(found), cameras.fov_deg_BV)


def _of_views(
    scene: LitScene, c2w_V44: Tensor, fov_deg_V: Tensor, resolution: int, rays_a_side: int
) -> Tensor:
    views = [
        first_albedo(scene, c2w_44.detach().cpu().numpy(), float(fov_deg), resolution, rays_a_side)
        for c2w_44, fov_deg in zip(c2w_V44, fov_deg_V, strict=True)
    ]
    return torch.from_numpy(np.stack(views))


def first_albedo(
    scene: LitScene,
    c2w: NDArray[np.float32],
    fov_deg: float,
    resolution: int,
    rays_a_side: int,
) -> NDArray[np.float32]:
    """Return [R, R, 6]: diffuse, then specular albedo of what pixels see first.

    Means over the rays_a_side^2 rays of each pixel; those that meet nothing count as black.
    """
    rays = Rays(c2w, fov_deg, resolution, rays_a_side)
    nothing = np.zeros((6, 1), np.float32)  # the last column, which a miss picks
    table = np.concatenate([np.concatenate([scene.diffuse, scene.specular]), nothing], axis=1)
    total = np.zeros((6, resolution**2), np.float32)
    for turn in range(rays.turns):
        total += table[:, scene.first_hits(rays.origin, rays.direction(turn)).triangle]
    mean: NDArray[np.float32] = total.T / np.float32(rays.turns)
    return mean.reshape(resolution, resolution, 6)
