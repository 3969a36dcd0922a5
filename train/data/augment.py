"""Exact symmetries of light transport: other scenes with known pictures, for nothing.

Each function returns a scene whose path-traced picture would be exactly the one it returns. They
hold for every scene that Trilight makes: materials are isotropic, colour channels never mix, and
light adds up, so that a scene with stronger or weaker lights has a known picture. Emission and
pictures are stored as log10(1 + x); relighting converts both to radiance and back, which is exact
to the rounding of float32.

Tensors are moved about by numpy, which shares their memory: torch would wake threads of its own in
every decoding thread, and they wait for cores in loops that took four times the work's own time.
"""

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import roma
import torch
from numpy.typing import NDArray
from torch import Tensor

from model.hits.textures import SurfaceTextures
from model.scene_tensors import SceneTensors
from model.sky import symmetries
from storage.records.material import laid_out
from train.data.scenes import TrainingScene

if TYPE_CHECKING:
    from train.settings import AugmentationSettings, Rotation


def augmented(
    scene: TrainingScene, settings: "AugmentationSettings", rng: np.random.Generator
) -> TrainingScene:
    """Return the scene under random symmetries; those that settings leave out draw nothing."""
    if settings.light_mix > 1:
        assert scene.lights_VLRR3 is not None
        exponent_L = rng.uniform(-1, 1, scene.lights_VLRR3.shape[1])
        factor_L = torch.from_numpy(settings.light_mix**exponent_L).float()
        scene = with_lights_mixed(scene, factor_L)
    if settings.light_scale > 1:
        scene = with_light_scaled(scene, float(settings.light_scale ** rng.uniform(-1, 1)))
    if settings.mirror and rng.random() < 0.5:
        scene = mirrored(scene)
    if settings.channels:
        scene = with_channels(scene, rng.permutation(3))
    if settings.vertex_order:
        turn_T = rng.integers(3, size=scene.tensors.num_triangles)
        scene = with_vertices_turned(scene, turn_T)
    if settings.rotation != "none" or settings.translation:
        shift = rng.normal(0, settings.translation, 3)
        scene = moved(scene, rotation_rand(settings.rotation, rng), torch.from_numpy(shift))
    return scene


def with_inputs_withheld(
    scene: SceneTensors, share: float, rng: np.random.Generator
) -> SceneTensors:
    """Return a traced scene whose views lack each input of model.hits.traced.INPUTS by chance.

    So that a network does not come to rest on one of them. Draws nothing where `share` is 0.
    """
    if not share or scene.traced is None:
        return scene
    kept_VI = rng.random(scene.traced.given_VI.shape) >= share
    return dataclasses.replace(
        scene, traced=scene.traced.without(torch.from_numpy(kept_VI).float())
    )


def rotation_rand(kind: "Rotation", rng: np.random.Generator) -> Tensor:
    """Return a random rotation matrix [3, 3], float64; the unit matrix for `none`."""
    if kind == "recipe":
        return roma.rotvec_to_rotmat(torch.from_numpy(rng.normal(0, 1, 3)))
    if kind == "uniform":
        # four normal numbers point in a uniform direction, and unit quaternions cover SO(3) evenly
        return roma.unitquat_to_rotmat(roma.quat_normalize(torch.from_numpy(rng.normal(size=4))))
    return torch.eye(3, dtype=torch.float64)


def moved(scene: TrainingScene, rotation_33: Tensor, shift_3: Tensor) -> TrainingScene:
    """Return the scene and its cameras after one rigid motion x -> R x + t; pictures stay.

    The products are taken in float64, so that poses stay rotations to the rounding of float32.
    """
    old = scene.tensors
    motion_44 = torch.eye(4, dtype=torch.float64)
    motion_44[:3, :3], motion_44[:3, 3] = rotation_33, shift_3
    tensors = dataclasses.replace(
        old,
        triangles_T33=(old.triangles_T33.double() @ rotation_33.T + shift_3).float(),
        normals_T33=(old.normals_T33.double() @ rotation_33.T).float(),
        c2w_V44=(motion_44 @ old.c2w_V44.double()).float(),
        sky=None if old.sky is None else symmetries.turned(old.sky, rotation_33.numpy()),
    )
    return dataclasses.replace(scene, tensors=tensors)


def mirrored(scene: TrainingScene) -> TrainingScene:
    """Return the scene behind a mirror at x = 0, seen by mirrored cameras.

    Four things change together: positions and normals, the order of vertices (which keeps the
    winding), the poses (whose own x axis turns too, so that they stay rotations), and the pictures.
    Drops the pictures of single lights.
    """
    old = scene.tensors
    sides_3 = np.array([-1, 1, 1], np.float32)
    sides_4 = np.array([-1, 1, 1, 1], np.float32)
    tensors = dataclasses.replace(
        old,
        triangles_T33=_tensor((old.triangles_T33.numpy() * sides_3)[:, ::-1]),
        normals_T33=_tensor((old.normals_T33.numpy() * sides_3)[:, ::-1]),
        # the reflection before and after: row and column of x change their signs
        c2w_V44=_tensor(sides_4[:, None] * old.c2w_V44.numpy() * sides_4),
        textures=_turned(old, np.tile(np.array([2, 1, 0]), (old.num_triangles, 1))),
        sky=None if old.sky is None else symmetries.behind_mirror(old.sky, sides_3),
    )
    target_VRR3 = torch.from_numpy(_columns_turned(scene.target_VRR3.numpy()))
    return dataclasses.replace(scene, tensors=tensors, target_VRR3=target_VRR3, lights_VLRR3=None)


def with_channels(scene: TrainingScene, order: np.ndarray) -> TrainingScene:
    """Return the scene with its colour channels in another order. Drops single lights."""
    numbers = np.arange(scene.tensors.material_TM.shape[1])
    for column, part in laid_out(scene.tensors.columns):
        if column.is_colour:
            numbers[part] = numbers[part][order]
    material_TM = _tensor(scene.tensors.material_TM.numpy()[:, numbers])
    textures = scene.tensors.textures
    if textures is not None:
        textures = textures.with_channels(order)
    sky = scene.tensors.sky
    if sky is not None:
        sky = symmetries.with_channels(sky, order)
    return dataclasses.replace(
        scene,
        tensors=dataclasses.replace(
            scene.tensors, material_TM=material_TM, textures=textures, sky=sky
        ),
        target_VRR3=torch.from_numpy(_channels_ordered(scene.target_VRR3.numpy(), order)),
        lights_VLRR3=None,
    )


def with_vertices_turned(scene: TrainingScene, turn_T: np.ndarray) -> TrainingScene:
    """Return the scene with each triangle's vertices (0, 1, 2) read from `turn_T[t]` on.

    A triangle is the same triangle whichever vertex is named first; the network's rotary positions
    are not the same, so it has to be shown.
    """
    order_T3 = (np.arange(3) + turn_T[:, None]) % 3
    old = scene.tensors
    tensors = dataclasses.replace(
        old,
        triangles_T33=_take_vertices(old.triangles_T33, order_T3),
        normals_T33=_take_vertices(old.normals_T33, order_T3),
        textures=_turned(old, order_T3),
    )
    return dataclasses.replace(scene, tensors=tensors)


def _take_vertices(values_T33: Tensor, order_T3: NDArray[np.int64]) -> Tensor:
    return _tensor(np.take_along_axis(values_T33.numpy(), order_T3[..., None], axis=1))


def _turned(tensors: SceneTensors, order_T3: NDArray[np.int64]) -> SurfaceTextures | None:
    textures = tensors.textures
    return None if textures is None else textures.with_vertices(order_T3)


def _columns_turned(pictures_VRR3: NDArray) -> NDArray:
    """Return pictures from right to left; whole pixels move in half of their numbers' time."""
    pixel = np.dtype((np.void, 3 * pictures_VRR3.itemsize))
    pixels_VRR1 = np.ascontiguousarray(pictures_VRR3).view(pixel)
    turned: NDArray = np.ascontiguousarray(pixels_VRR1[:, :, ::-1]).view(pictures_VRR3.dtype)
    return turned


def _channels_ordered(pictures_VRR3: NDArray, order: NDArray[np.int64]) -> NDArray:
    """Return pictures with their channels in another order; a fifth of the time of an index."""
    ordered = np.empty_like(pictures_VRR3)
    for channel, other in enumerate(order):
        ordered[..., channel] = pictures_VRR3[..., other]
    return ordered


def _tensor(values: NDArray[np.float32]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))


LN_10 = math.log(10.0)


def with_light_scaled(scene: TrainingScene, factor: float) -> TrainingScene:
    """Return the scene with all of its light `factor` times as strong. Drops single lights."""
    factor_T = torch.full((scene.tensors.num_triangles,), factor)
    tensors = _relit(scene.tensors, factor_T)
    if tensors.sky is not None:
        tensors = dataclasses.replace(tensors, sky=symmetries.scaled(tensors.sky, factor))
    lit = dataclasses.replace(scene, tensors=tensors, lights_VLRR3=None)
    if scene.levels_L is not None:
        return dataclasses.replace(lit, levels_L=_log10(factor * _linear(scene.levels_L)))
    return dataclasses.replace(lit, target_VRR3=_log10(factor * _linear(scene.target_VRR3)))


def with_lights_mixed(scene: TrainingScene, factor_L: Tensor) -> TrainingScene:
    """Return the scene with light i `factor_L[i]` times as strong.

    Drops the pictures of single lights, which the scene must hold (`TrainingScene.lights_VLRR3`).
    """
    assert scene.lights_VLRR3 is not None
    factor_T = torch.cat([factor_L, torch.ones(1)])[scene.light_T]  # -1: belongs to no light
    mixed_VRR3 = torch.einsum("l,vlijc->vijc", factor_L, scene.lights_VLRR3)
    return dataclasses.replace(
        scene,
        tensors=_relit(scene.tensors, factor_T),
        target_VRR3=_log10(mixed_VRR3),
        lights_VLRR3=None,
        levels_L=None,
    )


def _relit(tensors: SceneTensors, factor_T: Tensor) -> SceneTensors:
    """Return the tensors with the radiance of each triangle multiplied by its factor."""
    material_TM = tensors.material_TM.clone()
    for column, part in laid_out(tensors.columns):
        if column.is_radiance and column.is_log_encoded:
            material_TM[:, part] = _log10(factor_T[:, None] * _linear(material_TM[:, part]))
        elif column.is_radiance:
            material_TM[:, part] *= factor_T[:, None]
    return dataclasses.replace(tensors, material_TM=material_TM)


def _linear(log10: Tensor) -> Tensor:
    return torch.expm1(log10 * LN_10)


def _log10(linear: Tensor) -> Tensor:
    return torch.log1p(linear) / LN_10
