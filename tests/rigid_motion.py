"""Moves a scene and its cameras together, which must not change what the cameras see."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.records.scene import Scene


def moved(scene: Scene, rotation: NDArray[np.float64], translation: ArrayLike) -> Scene:
    """Return the scene, its sky and its cameras after the rigid motion x -> R x + t.

    Sums are taken in float64 and rounded once.

    Args:
        scene: what is moved.
        rotation: [3, 3] R.
        translation: [3] t, world units.
    """
    shift = np.asarray(translation, np.float64)
    pose = scene.c2w.astype(np.float64)
    pose[:, :3] = np.einsum("ij,cjk->cik", rotation, pose[:, :3])
    pose[:, :3, 3] += shift
    positions = np.einsum("ij,vj->vi", rotation, scene.vertex_positions.astype(np.float64)) + shift
    normals = np.einsum("ij,vj->vi", rotation, scene.vertex_normals.astype(np.float64))
    sky = scene.environment
    if sky is not None:
        sky = dataclasses.replace(sky, rotation=(rotation @ sky.rotation).astype(np.float32))
    return dataclasses.replace(
        scene,
        environment=sky,
        vertex_positions=positions.astype(np.float32),
        vertex_normals=normals.astype(np.float32),
        c2w=pose.astype(np.float32),
    )
