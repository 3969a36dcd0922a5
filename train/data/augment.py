"""Exact symmetries of light transport: other scenes with known pictures, for nothing.

Each function returns a scene whose path-traced picture would be exactly the one it returns. They
hold for every scene that Trilight makes: materials are isotropic, and colour channels never mix.

Tensors are moved about by numpy, which shares their memory: torch would wake threads of its own in
every decoding thread, and they wait for cores in loops that took four times the work's own time.
"""

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray
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
    sides_3 = np.array([-1, 1, 1], np.float32)
    sides_4 = np.array([-1, 1, 1, 1], np.float32)
    tensors = dataclasses.replace(
        old,
        triangles_T33=_tensor((old.triangles_T33.numpy() * sides_3)[:, ::-1]),
        normals_T33=_tensor((old.normals_T33.numpy() * sides_3)[:, ::-1]),
        # the reflection before and after: row and column of x change their signs
        c2w_V44=_tensor(sides_4[:, None] * old.c2w_V44.numpy() * sides_4),
    )
    target_VRR3 = _tensor(scene.target_VRR3.numpy()[:, :, ::-1])
    return dataclasses.replace(scene, tensors=tensors, target_VRR3=target_VRR3)


def with_channels(scene: TrainingScene, order: np.ndarray) -> TrainingScene:
    """Return the scene with its colour channels in another order, materials and pictures alike."""
    columns = np.arange(scene.tensors.material_T10.shape[1])
    for channels in (DIFFUSE, SPECULAR, EMISSION):
        columns[channels] = columns[channels][order]
    material_T10 = _tensor(scene.tensors.material_T10.numpy()[:, columns])
    return dataclasses.replace(
        scene,
        tensors=dataclasses.replace(scene.tensors, material_T10=material_T10),
        target_VRR3=_tensor(scene.target_VRR3.numpy()[..., order]),
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
    )
    return dataclasses.replace(scene, tensors=tensors)


def with_views(scene: TrainingScene, views: np.ndarray) -> TrainingScene:
    """Return the scene seen by some of its cameras."""
    old = scene.tensors
    tensors = dataclasses.replace(
        old,
        c2w_V44=_tensor(old.c2w_V44.numpy()[views]),
        fov_deg_V=_tensor(old.fov_deg_V.numpy()[views]),
    )
    target_VRR3 = _tensor(scene.target_VRR3.numpy()[views])
    return dataclasses.replace(scene, tensors=tensors, target_VRR3=target_VRR3)


def _take_vertices(values_T33: Tensor, order_T3: NDArray[np.int64]) -> Tensor:
    return _tensor(np.take_along_axis(values_T33.numpy(), order_T3[..., None], axis=1))


def _tensor(values: NDArray[np.float32]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))
