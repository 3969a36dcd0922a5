"""Small scenes made by hand, for tests that need a valid scene and not a sampled one.

And moves of a scene and its cameras together, which must not change what the cameras see.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import look_at_c2w
from storage.dataset.staging import stage_members
from storage.records.material import completed_rows
from storage.records.objects import Failure
from storage.records.profiles import Profile
from storage.records.sample import Sample, ViewRecord, encode_sample
from storage.records.scene import Scene, SceneObject

FLOOR, LIGHT = 0, 1


def tiny_scene(**changes: Any) -> Scene:
    """Return a floor of two triangles below one white light, seen by two cameras."""
    positions = np.array(
        [
            [-1, -1, 0],
            [1, -1, 0],
            [1, 1, 0],
            [-1, 1, 0],
            [-0.1, -0.1, 2],
            [0, 0.1, 2],
            [0.1, -0.1, 2],
        ],
        np.float32,
    )
    normals = np.array([[0, 0, 1]] * 4 + [[0, 0, -1]] * 3, np.float32)
    materials = np.zeros((2, 10), np.float32)
    materials[FLOOR] = [0.5, 0.4, 0.3, 0.2, 0.2, 0.2, 0.5, 0, 0, 0]
    materials[LIGHT, 6:] = [1, 100, 100, 100]
    poses = [look_at_c2w(eye=eye, target=[0, 0, 0], up=[0, 0, 1]) for eye in ([2, 0, 1], [0, 2, 1])]
    fields: dict[str, Any] = {
        "vertex_positions": positions,
        "vertex_normals": normals,
        "faces": np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.uint32),
        "material_index": np.array([FLOOR, FLOOR, LIGHT], np.uint16),
        "materials": completed_rows(materials, None),
        "object_index": np.array([FLOOR, FLOOR, LIGHT], np.uint16),
        "c2w": np.stack(poses).astype(np.float32),
        "fov_deg": np.array([45, 40], np.float32),
        "objects": (
            SceneObject(name="floor", kind="shell"),
            SceneObject(name="light", kind="emitter"),
        ),
        "provenance": {"template": "plane", "scene_index": 0, "attempt": 0, "seed": 0},
    }
    return Scene(**{**fields, **changes})


def from_above(height: float = 1.0, fov_deg: float = 90.0, **changes: Any) -> Scene:
    """Return the floor of the tiny scene, seen straight from above, +Y at the picture's top."""
    pose = look_at_c2w(eye=[0, 0, height], target=[0, 0, 0], up=[0, 1, 0])[None]
    cameras = {"c2w": pose.astype(np.float32), "fov_deg": np.array([fov_deg], np.float32)}
    return tiny_scene(**cameras, **changes)


def tiny_sample(key: str = "000000000", resolution: int = 16, seed: int = 0) -> Sample:
    """Return a sample of the tiny scene with random pictures that half floats hold exactly."""
    rng = np.random.default_rng(seed)
    scene = tiny_scene()
    radiance = rng.random((scene.num_views, resolution, resolution, 3)).astype(np.float16)
    view = ViewRecord(
        spp=128,
        noise_floor_db=41.5,
        noise_floor_linear_db=33.25,
        object_noise_floor_db=40.5,
        coverage=0.25,
        at_cap=False,
        seed=7,
        camera_attempt=0,
    )
    return Sample(
        key=key,
        scene=scene,
        radiance_rgb=radiance.astype(np.float32),
        views=(view,) * scene.num_views,
    )


def stage_scene(
    folder: Path,
    scene_index: int,
    sample: Sample | None,
    failures: list[Failure],
    profile: Profile,
) -> None:
    """Stage what became of a scene, as a worker does."""
    stage_members(folder, scene_index, encode_sample(sample, profile) if sample else {}, failures)


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


def mirrored(scene: Scene) -> Scene:
    """Return the scene with x negated, its triangles' second and third corners exchanged."""
    flip = np.array([-1, 1, 1], np.float32)
    poses = scene.c2w.copy()
    poses[:, :3] *= flip[:, None]
    poses[:, :3, 0] *= -1  # a camera stays right-handed: its own x points to the other side
    return dataclasses.replace(
        scene,
        vertex_positions=scene.vertex_positions * flip,
        vertex_normals=scene.vertex_normals * flip,
        faces=scene.faces[:, [0, 2, 1]],
        c2w=poses,
    )
