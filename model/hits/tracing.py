"""Scenes as the network has them -> what is traced of them and of their views."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from model.config import ModelConfig
from model.hits.lit_scene import LitScene
from model.hits.radiosity import SceneLight, scene_light
from model.hits.textures import SurfaceTextures
from model.hits.traced import INPUTS, Traced, stack_traced
from model.hits.view_inputs import ViewInputs, view_inputs
from model.scene_tensors import Cameras, SceneBatch, SceneTensors
from model.sky.known import require_known_sky
from storage.conventions import radiance_from_log10
from storage.records.environment import Environment
from storage.records.material import PUBLISHED_COLUMNS, laid_out


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedScene:
    """A scene that can be asked for any view."""

    lit: LitScene
    light: SceneLight

    def view(
        self, c2w_44: Tensor, fov_deg: float, resolution: int, config: ModelConfig, seed: int
    ) -> ViewInputs:
        """Return what is traced for one view."""
        return view_inputs(
            self.lit,
            self.light,
            c2w_44.detach().cpu().numpy(),
            fov_deg,
            resolution,
            rays_a_side=config.hit_rays,
            anchors_a_side=anchors_a_side(config, resolution),
            gather_rays=config.gather_rays,
            sky_rays=config.sky_rays,
            seed=seed,
        )


def anchors_a_side(config: ModelConfig, resolution: int) -> int:
    """Return how many anchors a picture has along a side: a divisor of its width."""
    return int(np.gcd(config.hit_anchors, resolution))


def lit_scene(
    triangles_T33: Tensor,
    normals_T33: Tensor,
    materials_TM: Tensor,
    textures: SurfaceTextures | None = None,
    sky: Environment | None = None,
) -> LitScene:
    """Return the surfaces of a scene.

    Args:
        triangles_T33, normals_T33: as in SceneTensors.
        materials_TM: its published columns.
        textures, sky: as in SceneTensors.
    """
    materials = materials_TM.detach().cpu().numpy().copy()
    for column, part in laid_out(PUBLISHED_COLUMNS):
        if column.is_log_encoded:
            materials[:, part] = np.maximum(radiance_from_log10(materials[:, part]), 0)
    triangles, normals = (each.detach().cpu().numpy() for each in (triangles_T33, normals_T33))
    return LitScene(triangles, normals, materials, textures, sky)


def traced_batch(batch: SceneBatch) -> tuple[TracedScene, ...]:
    """Return the scenes of a batch, without their padding, ready for rays."""
    return tuple(TracedScene(lit=lit, light=scene_light(lit)) for lit in lit_scenes(batch))


def lit_scenes(batch: SceneBatch) -> tuple[LitScene, ...]:
    """Return the surfaces of the scenes of a batch, without their padding."""
    materials = batch.material_of(PUBLISHED_COLUMNS)
    found = []
    for row in range(len(materials)):
        there = slice(None) if batch.is_triangle_BT is None else batch.is_triangle_BT[row]
        found.append(
            lit_scene(
                batch.triangles_BT33[row][there],
                batch.normals_BT33[row][there],
                materials[row][there],
                None if batch.textures is None else batch.textures[row],
                None if batch.skies is None else batch.skies[row],
            )
        )
    return tuple(found)


def with_traced(
    scene: SceneTensors, resolution: int, config: ModelConfig, seed: int = 0
) -> SceneTensors:
    """Return a scene with what is traced of its views: what a trainer's threads do ahead.

    `seed` is that of the noise: a network that saw one noise alone might learn it.
    """
    require_known_sky(scene.sky, config)
    lit = lit_scene_of(scene)
    ready = TracedScene(lit=lit, light=scene_light(lit))
    traced = traced_views(ready, scene.c2w_V44, scene.fov_deg_V, resolution, config, seed)
    return dataclasses.replace(scene, traced=traced)


def lit_scene_of(scene: SceneTensors) -> LitScene:
    """Return the surfaces of a scene."""
    columns = {column.name: part for column, part in laid_out(scene.columns)}
    numbers = [scene.material_TM[:, columns[name]] for name in PUBLISHED_COLUMNS]
    materials_TM = torch.cat(numbers, dim=-1)
    return lit_scene(
        scene.triangles_T33, scene.normals_T33, materials_TM, scene.textures, scene.sky
    )


def traced_cameras(
    scenes: tuple[TracedScene, ...], cameras: Cameras, resolution: int, config: ModelConfig
) -> Traced:
    """Return what is traced of any cameras of the scenes of a batch.

    It is where the cameras are, and of their type.
    """
    found = [
        traced_views(scene, c2w_V44, fov_deg_V, resolution, config)
        for scene, c2w_V44, fov_deg_V in zip(
            scenes, cameras.c2w_BV44, cameras.fov_deg_BV, strict=True
        )
    ]
    longest = max(scene.lit.num_triangles for scene in scenes)
    return stack_traced(found, longest).converted(lambda each: like(each, cameras.fov_deg_BV))


def like(numbers: Tensor, other: Tensor) -> Tensor:
    """Return numbers where another tensor is, and, but for indices, of its type."""
    return numbers.to(other.device, other.dtype if numbers.is_floating_point() else None)


def traced_views(
    scene: TracedScene,
    c2w_V44: Tensor,
    fov_deg_V: Tensor,
    resolution: int,
    config: ModelConfig,
    seed: int = 0,
) -> Traced:
    """Return the tensors of some views of a scene, on the CPU."""
    views = [
        scene.view(c2w_44, float(fov_deg), resolution, config, seed)
        for c2w_44, fov_deg in zip(c2w_V44, fov_deg_V, strict=True)
    ]
    return Traced(
        sides_T12=sides_of(scene.light),
        unit_3=torch.from_numpy(scene.light.mean_3),
        pixels_VRRC=torch.from_numpy(np.stack([view.pixels for view in views])),
        anchor_VA=torch.from_numpy(np.stack([view.anchor for view in views])),
        gathered_VA3=torch.from_numpy(np.stack([view.gathered for view in views])),
        given_VI=torch.ones(len(views), len(INPUTS)),
    )


def sides_of(light: SceneLight) -> Tensor:
    """Return [T, 12]: direct and indirect light of the front, then of the back."""
    parts = [part[side] for side in (0, 1) for part in (light.direct_2T3, light.indirect_2T3)]
    return torch.from_numpy(np.concatenate(parts, axis=-1))
