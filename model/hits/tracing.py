"""Scenes as the network has them -> traced inputs of them and of their views."""

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.config import ModelConfig
from model.hits.anchors import Rays
from model.hits.device_arrays import DeviceArray
from model.hits.lit_scene import LitScene
from model.hits.traced import INPUTS, Traced, denoise_traced, stack_traced
from model.hits.view_inputs import view_inputs
from model.scene_tensors import (
    Cameras,
    SceneBatch,
    SceneTensors,
    batch_scenes,
    map_tensors,
    require_known_sky,
)
from storage.conventions import radiance_from_log10
from storage.records.material import PUBLISHED_COLUMNS, laid_out


def lit_scenes(batch: SceneBatch) -> tuple[LitScene, ...]:
    """Return the surfaces of the scenes of a batch, without their padding."""
    materials_BTM = batch.material_of(PUBLISHED_COLUMNS)
    scenes = []
    for row in range(len(materials_BTM)):
        rows = slice(None) if batch.is_triangle_BT is None else batch.is_triangle_BT[row]
        triangles, normals, materials = (
            each[row][rows].detach().cpu().numpy()
            for each in (batch.triangles_BT33, batch.normals_BT33, materials_BTM)
        )
        materials = materials.copy()
        for column, part in laid_out(PUBLISHED_COLUMNS):
            if column.is_log_encoded:
                materials[:, part] = np.maximum(radiance_from_log10(materials[:, part]), 0)
        textures = None if batch.textures is None else batch.textures[row]
        sky = None if batch.skies is None else batch.skies[row]
        scenes.append(LitScene(triangles, normals, materials, textures, sky))
    return tuple(scenes)


def with_traced(
    scene: SceneTensors,
    resolution: int,
    config: ModelConfig,
    seed: int = 0,
    device: torch.device | None = None,
) -> SceneTensors:
    """Return a scene with what rays find of its views; a trainer's threads do this ahead.

    That is Traced for `hits`, the albedo for demodulated bundles, and nothing for other networks.

    Args:
        scene, resolution, config: of the views.
        seed: of the noise: a network that saw one noise alone might learn it.
        device: what traces `hits`, if it can; the result is where the scene is.
    """
    if not config.hit_rays:
        return scene
    (lit,) = lit_scenes(batch_scenes([scene]))
    if not config.traces_hits:
        cameras = scene.c2w_V44, scene.fov_deg_V
        albedo_VRR6 = albedo_of_views(lit, *cameras, resolution, config.hit_rays)
        return dataclasses.replace(scene, albedo_VRR6=like(albedo_VRR6, scene.c2w_V44))
    require_known_sky(scene.sky, config)
    if device is not None:
        lit = lit.on_device(device)
    place = scene.c2w_V44.device
    traced = traced_views(lit, scene.c2w_V44, scene.fov_deg_V, resolution, config, seed)
    traced = map_tensors(denoise_traced(traced, config), lambda each: each.to(place))
    return dataclasses.replace(scene, traced=traced)


def traced_cameras(
    scenes: tuple[LitScene, ...], cameras: Cameras, resolution: int, config: ModelConfig
) -> Traced:
    """Trace the inputs of any cameras of the scenes of a batch.

    It is where the cameras are, and of their type.
    """
    views = zip(scenes, cameras.c2w_BV44, cameras.fov_deg_BV, strict=True)
    traced = [traced_views(*each, resolution, config) for each in views]
    return map_tensors(stack_traced(traced), lambda each: like(each, cameras.fov_deg_BV))


def like(numbers: Tensor, other: Tensor) -> Tensor:
    """Return numbers where another tensor is, and, but for indices, of its type."""
    return numbers.to(other.device, other.dtype if numbers.is_floating_point() else None)


def traced_views(
    scene: LitScene,
    c2w_V44: Tensor,
    fov_deg_V: Tensor,
    resolution: int,
    config: ModelConfig,
    seed: int = 0,
) -> Traced:
    """Return the tensors of some views of a scene, where its rays are traced."""
    place = scene.place
    views = []
    for c2w_44, fov_deg in zip(c2w_V44, fov_deg_V, strict=True):
        camera = c2w_44.detach(), fov_deg
        if place is None:
            c2w: Any = camera[0].cpu().numpy()
            angle: Any = float(fov_deg)
        else:
            c2w, angle = (DeviceArray(each.to(place.device), place) for each in camera)
        views.append(view_inputs(scene, c2w, angle, resolution, config, seed))
    pixels, anchor, gathered = (as_tensor(np.stack(each)) for each in zip(*views, strict=True))
    given_VI = np.ones((len(views), len(INPUTS)), np.float32)
    return Traced(
        sides_T12=as_tensor(scene.light.sides_T12),
        unit_3=as_tensor(scene.light.mean_3),
        pixels_VRRC=pixels,
        anchor_VA=anchor,
        gathered_VA3=gathered,
        given_VI=as_tensor(scene.here(given_VI)),
    )


def albedo_of_cameras(
    scenes: tuple[LitScene, ...], cameras: Cameras, resolution: int, rays_a_side: int
) -> Tensor:
    """Return the albedo [B, V, R, R, 6] that cameras see: where they are, and of their type."""
    views = zip(scenes, cameras.c2w_BV44, cameras.fov_deg_BV, strict=True)
    albedo = [albedo_of_views(*each, resolution, rays_a_side) for each in views]
    return like(torch.stack(albedo), cameras.fov_deg_BV)


def albedo_of_views(
    scene: LitScene, c2w_V44: Tensor, fov_deg_V: Tensor, resolution: int, rays_a_side: int
) -> Tensor:
    """Return the diffuse and specular albedo [V, R, R, 6] of visible surfaces, float32 on the CPU.

    Rays go to the first triangle that is no lamp. Each pixel is the mean over its rays_a_side^2
    rays; a miss counts as black.
    """
    albedo = np.concatenate([scene.means.diffuse, scene.means.specular])
    table = np.pad(albedo, ((0, 0), (0, 1)))  # the last column, black, is what a miss picks
    views = []
    for c2w_44, fov_deg in zip(c2w_V44.detach().cpu().numpy(), fov_deg_V, strict=True):
        rays = Rays(c2w_44, float(fov_deg), resolution, rays_a_side)
        total = np.zeros((6, resolution**2), np.float32)
        for jitter in range(rays.rays_per_pixel):
            total += table[:, scene.first_hits(rays.origin, rays.direction(jitter)).triangle]
        views.append(total.T / np.float32(rays.rays_per_pixel))
    return torch.from_numpy(np.stack(views)).unflatten(1, (resolution, resolution))


def as_tensor(array: NDArray | DeviceArray) -> Tensor:
    """Return the tensor of an array of the host, in whose memory it is, or of a device."""
    return array.tensor if isinstance(array, DeviceArray) else torch.from_numpy(array)
