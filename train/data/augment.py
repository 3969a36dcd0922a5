"""Exact symmetries of light transport: other scenes with known pictures, for nothing.

Each function returns a scene whose path-traced picture would be exactly the one it returns. They
hold for every scene that Trilight makes: materials are isotropic, and colour channels never mix.
"""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from storage.conventions import DIFFUSE, EMISSION, SPECULAR
from train.data.scenes import TrainingScene


def augmented(scene: TrainingScene, rng: np.random.Generator) -> TrainingScene:
    """Return the scene under random symmetries, uniform over their group."""
    if rng.random() < 0.5:
        scene = mirrored(scene)
    scene = with_channels(scene, rng.permutation(3))
    return with_vertices_turned(scene, rng.integers(3, size=scene.tensors.num_triangles))


def mirrored(scene: TrainingScene) -> TrainingScene:
    """Return the scene behind a mirror at x = 0, seen by mirrored cameras.

    Four things change together: positions and normals, the order of vertices (which keeps the
    winding), the poses (whose own x axis turns too, so that they stay rotations), and the pictures.
    """
    old = scene.tensors
    flip_3 = torch.tensor([-1.0, 1.0, 1.0])
    flip_44 = torch.diag(torch.tensor([-1.0, 1.0, 1.0, 1.0]))
    tensors = dataclasses.replace(
        old,
        triangles_T33=(old.triangles_T33 * flip_3).flip(1),
        normals_T33=(old.normals_T33 * flip_3).flip(1),
        c2w_V44=flip_44 @ old.c2w_V44 @ flip_44,
    )
    return dataclasses.replace(scene, tensors=tensors, target_VRR3=scene.target_VRR3.flip(2))


def with_channels(scene: TrainingScene, order: np.ndarray) -> TrainingScene:
    """Return the scene with its colour channels in another order, materials and pictures alike."""
    columns = np.arange(scene.tensors.material_T10.shape[1])
    for channels in (DIFFUSE, SPECULAR, EMISSION):
        columns[channels] = columns[channels][order]
    material_T10 = scene.tensors.material_T10[:, torch.from_numpy(columns)]
    return dataclasses.replace(
        scene,
        tensors=dataclasses.replace(scene.tensors, material_T10=material_T10),
        target_VRR3=scene.target_VRR3[..., torch.from_numpy(order.copy())],
    )


def with_vertices_turned(scene: TrainingScene, turn_T: np.ndarray) -> TrainingScene:
    """Return the scene with each triangle's vertices (0, 1, 2) read from `turn_T[t]` on.

    A triangle is the same triangle whichever vertex is named first; the network's rotary positions
    are not the same, so it has to be shown.
    """
    order_T3 = torch.from_numpy((np.arange(3) + turn_T[:, None]) % 3)
    old = scene.tensors
    tensors = dataclasses.replace(
        old,
        triangles_T33=_take_vertices(old.triangles_T33, order_T3),
        normals_T33=_take_vertices(old.normals_T33, order_T3),
    )
    return dataclasses.replace(scene, tensors=tensors)


def with_views(scene: TrainingScene, views: np.ndarray) -> TrainingScene:
    """Return the scene seen by some of its cameras."""
    rows = torch.from_numpy(views.copy())
    tensors = dataclasses.replace(
        scene.tensors, c2w_V44=scene.tensors.c2w_V44[rows], fov_deg_V=scene.tensors.fov_deg_V[rows]
    )
    return dataclasses.replace(scene, tensors=tensors, target_VRR3=scene.target_VRR3[rows])


def _take_vertices(values_T33: Tensor, order_T3: Tensor) -> Tensor:
    return values_T33.gather(1, order_T3[..., None].expand(-1, -1, 3))
