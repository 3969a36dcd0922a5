"""Scenes as the network has them -> traced inputs of them and of their views."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.config import HitStage, ModelConfig, hit_stage
from model.hits.device_arrays import DeviceArray, DevicePlace
from model.hits.device_rays import DeviceTriangles, compiled_kernel
from model.hits.lit_scene import LitScene
from model.hits.radiosity import SceneLight, scene_light
from model.hits.traced import INPUTS, Traced, denoise_traced, stack_traced
from model.hits.view_inputs import ViewInputs, view_inputs
from model.scene_tensors import (
    Cameras,
    SceneBatch,
    SceneTensors,
    batch_scenes,
    map_tensors,
    require_known_sky,
)
from storage.conventions import radiance_from_log10
from storage.raycast.caster import RayCaster
from storage.records.material import PUBLISHED_COLUMNS, laid_out

MOST_LAMPS = 2**11
"""Emitting triangles with which a scene's rays are traced by a GPU: their random numbers take 1 GB
at 256 pixels, and 4 GB at 512."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TracedScene:
    """A scene whose views can be traced."""

    lit: LitScene
    light: SceneLight
    sides_T12: Tensor
    """Direct and indirect light of the front, then of the back, of each triangle."""
    unit_3: Tensor
    """The scene's mean light (model.hits.radiosity)."""

    def on(self, device: torch.device) -> "TracedScene":
        """Return the scene on a GPU that traces its rays; itself where none does.

        Scenes with thousands of lamps stay with the CPU.
        """
        if len(self.lit.lamps) > MOST_LAMPS or compiled_kernel(device) is None:
            return self
        return self.on_place(DevicePlace(device), DeviceTriangles)

    def on_place(self, place: DevicePlace, caster: Callable[..., RayCaster]) -> "TracedScene":
        """Return the scene there, with rays as `caster` prepares them."""
        tables = {each.name: getattr(self.light, each.name) for each in fields(SceneLight)}
        held: dict[str, Any] = {
            name: place.array(table) for name, table in tables.items() if table is not None
        }
        return TracedScene(
            lit=self.lit.on(place, caster),
            light=SceneLight(**held),
            sides_T12=self.sides_T12.to(place.device),
            unit_3=self.unit_3.to(place.device),
        )

    def view(
        self, c2w_44: Tensor, fov_deg: Tensor, resolution: int, stage: HitStage, seed: int
    ) -> ViewInputs:
        """Trace the inputs of one view."""
        place = self.lit.place
        c2w: Any = c2w_44.detach().cpu().numpy() if place is None else DeviceArray(c2w_44, place)
        angle: Any = float(fov_deg) if place is None else DeviceArray(fov_deg, place)
        return view_inputs(
            self.lit,
            self.light,
            c2w,
            angle,
            resolution,
            rays_a_side=stage.hit_rays,
            anchors_a_side=math.gcd(stage.hit_anchors, resolution),  # it divides the width
            gather_rays=stage.gather_rays,
            sky_rays=stage.sky_rays,
            shades_each_ray=not stage.denoises(resolution),
            seed=seed,
        )


def traced_batch(batch: SceneBatch) -> tuple[TracedScene, ...]:
    """Return the scenes of a batch, without their padding, ready for rays."""
    return tuple(traced_scene(lit) for lit in lit_scenes(batch))


def traced_scene(lit: LitScene) -> TracedScene:
    """Return surfaces, with the light that they receive, ready for rays."""
    light = scene_light(lit)
    parts = [part[side] for side in (0, 1) for part in (light.direct_2T3, light.indirect_2T3)]
    return TracedScene(
        lit=lit,
        light=light,
        sides_T12=torch.from_numpy(np.concatenate(parts, axis=-1)),
        unit_3=torch.from_numpy(light.mean_3),
    )


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


def lit_scene_of(scene: SceneTensors) -> LitScene:
    """Return the surfaces of a scene."""
    (lit,) = lit_scenes(batch_scenes([scene]))
    return lit


def with_traced(
    scene: SceneTensors,
    resolution: int,
    config: ModelConfig,
    seed: int = 0,
    device: torch.device | None = None,
) -> SceneTensors:
    """Return a scene with the traced inputs of its views; a trainer's threads do this ahead.

    Args:
        scene, resolution, config: of the views.
        seed: of the noise: a network that saw one noise alone might learn it.
        device: what traces, if it can; the result is where the scene is.
    """
    require_known_sky(scene.sky, config)
    ready = traced_scene(lit_scene_of(scene))
    if device is not None:
        ready = ready.on(device)
    cameras = [each.to(ready.unit_3.device) for each in (scene.c2w_V44, scene.fov_deg_V)]
    stage = hit_stage(config)
    traced = traced_views(ready, cameras[0], cameras[1], resolution, stage, seed)
    place = scene.c2w_V44.device
    traced = map_tensors(denoise_traced(traced, stage), lambda each: each.to(place))
    return dataclasses.replace(scene, traced=traced)


def traced_cameras(
    scenes: tuple[TracedScene, ...], cameras: Cameras, resolution: int, stage: HitStage
) -> Traced:
    """Trace the inputs of any cameras of the scenes of a batch.

    It is where the cameras are, and of their type.
    """
    traced = [
        traced_views(scene, c2w_V44, fov_deg_V, resolution, stage)
        for scene, c2w_V44, fov_deg_V in zip(
            scenes, cameras.c2w_BV44, cameras.fov_deg_BV, strict=True
        )
    ]
    return map_tensors(stack_traced(traced), lambda each: like(each, cameras.fov_deg_BV))


def like(numbers: Tensor, other: Tensor) -> Tensor:
    """Return numbers where another tensor is, and, but for indices, of its type."""
    return numbers.to(other.device, other.dtype if numbers.is_floating_point() else None)


def traced_views(
    scene: TracedScene,
    c2w_V44: Tensor,
    fov_deg_V: Tensor,
    resolution: int,
    stage: HitStage,
    seed: int = 0,
) -> Traced:
    """Return the tensors of some views of a scene, where its rays are traced."""
    views = [
        scene.view(c2w_44, fov_deg, resolution, stage, seed)
        for c2w_44, fov_deg in zip(c2w_V44, fov_deg_V, strict=True)
    ]
    return Traced(
        sides_T12=scene.sides_T12,
        unit_3=scene.unit_3,
        pixels_VRRC=_stack([view.pixels for view in views]),
        anchor_VA=_stack([view.anchor for view in views]),
        gathered_VA3=_stack([view.gathered for view in views]),
        given_VI=torch.ones(len(views), len(INPUTS), device=scene.unit_3.device),
    )


def _stack(arrays: list[NDArray]) -> Tensor:
    stacked: Any = np.stack(arrays)
    return stacked.tensor if isinstance(stacked, DeviceArray) else torch.from_numpy(stacked)
