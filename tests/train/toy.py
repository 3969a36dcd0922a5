"""A small dataset with analytic pictures: floor, box, one light, Lambert's law, no shadows.

Real enough to learn from (position, colour and orientation all matter) and made in milliseconds.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage.conventions import camera_rays, look_at_c2w
from storage.dataset import Dataset, open_dataset
from storage.layout import DatasetFolder
from storage.manifest import Manifest, index_shard, write_manifest
from storage.sample import Sample, ViewRecord, encode_sample, sample_key
from storage.scene import Scene, SceneObject
from storage.seeds import rng_for
from storage.shard_writer import write_shard

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
SIDES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
LIGHT = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, -0.1, 0]])
EMISSION = 20.0
RESOLUTION = 32
VIEWS = 2


def toy_scene(index: int, *, views: int = VIEWS, boxes: int | None = None) -> Scene:
    rng = rng_for(5, "toy", index)
    quads = [np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])]
    for _ in range(boxes if boxes is not None else int(rng.integers(1, 4))):
        centre = np.array([*rng.uniform(-0.3, 0.3, 2), 0.2])
        quads += list((CORNERS * rng.uniform(0.08, 0.18, 3) + centre)[SIDES])
    corners = np.concatenate([quad[[[0, 1, 2], [0, 2, 3]]] for quad in quads])
    light = LIGHT + np.array([*rng.uniform(-1, 1, 2), 1.5])
    corners = np.concatenate([corners, light[None]])
    num_objects = (len(quads) - 1) // 6 + 2
    owner = np.array([0, 0, *np.repeat(np.arange(1, num_objects - 1), 12), num_objects - 1])
    materials = np.zeros((num_objects, 10), np.float32)
    materials[:-1, 0:3] = rng.uniform(0.1, 0.9, (num_objects - 1, 3))
    materials[:, 6] = 0.5
    materials[-1, 7:10] = EMISSION
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    kinds = ["shell", *["object"] * (num_objects - 2), "emitter"]
    poses = [look_at_c2w(eye=eye, target=[0, 0, 0.1], up=[0, 0, 1]) for eye in _eyes(rng, views)]
    return Scene(
        vertex_positions=corners.reshape(-1, 3).astype(np.float32),
        vertex_normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        faces=np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3),
        material_index=owner.astype(np.uint16),
        materials=materials,
        object_index=owner.astype(np.uint16),
        c2w=np.stack(poses).astype(np.float32),
        fov_deg=rng.uniform(35, 55, views).astype(np.float32),
        objects=tuple(
            SceneObject(name=f"{kind}{row}", kind=kind)  # type: ignore[arg-type]
            for row, kind in enumerate(kinds)
        ),
        provenance={"template": "toy", "scene": index},
    )


def _eyes(rng: np.random.Generator, views: int) -> NDArray:
    azimuth = rng.uniform(0, 2 * np.pi, views)
    return np.stack([1.6 * np.cos(azimuth), 1.6 * np.sin(azimuth), rng.uniform(0.5, 1.2, views)], 1)


def toy_picture(scene: Scene, view: int, resolution: int) -> NDArray[np.float32]:
    """Return [R, R, 3]: Lambert's law under one point light, nearest triangle, black background."""
    origin, rays = camera_rays(scene.c2w[view], float(scene.fov_deg[view]), resolution)
    corners = scene.vertex_positions[scene.faces].astype(np.float64)
    lit = ~scene.triangle_emits
    light = corners[~lit][0].mean(axis=0)
    a, b, c = np.moveaxis(corners[lit], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = ((a - origin) * normal).sum(1) / (rays @ normal.T)
        point = origin + depth[..., None] * rays[:, :, None]
        inside = depth > 0
        for first, second in ((a, b), (b, c), (c, a)):
            side = np.cross(second - first, point - first)
            inside &= (side * normal).sum(-1) >= 0
    depth = np.where(inside, depth, np.inf)
    nearest = depth.argmin(axis=-1)
    hit = np.isfinite(depth.min(axis=-1))
    place = np.take_along_axis(point, nearest[..., None, None], 2)[:, :, 0]
    to_light = light - np.where(hit[..., None], place, 0)
    distance = np.linalg.norm(to_light, axis=-1)
    cosine = abs((to_light * normal[nearest]).sum(-1)) / distance
    albedo = scene.materials[scene.material_index[lit]][:, :3][nearest]
    shaded = 0.2 * EMISSION * albedo * (cosine / distance**2 * hit)[..., None]
    return shaded.astype(np.float32)


def toy_sample(index: int, *, resolution: int = RESOLUTION, views: int = VIEWS) -> Sample:
    scene = toy_scene(index, views=views)
    pictures = [toy_picture(scene, view, resolution) for view in range(views)]
    record = ViewRecord(
        spp=1,
        noise_floor_db=100.0,
        noise_floor_linear_db=100.0,
        object_noise_floor_db=100.0,
        coverage=0.5,
        at_cap=False,
        seed=0,
        camera_attempt=0,
    )
    return Sample(
        key=sample_key(index),
        scene=scene,
        radiance_rgb=np.stack(pictures),
        views=(record,) * views,
    )


def write_toy_dataset(
    folder: Path,
    *,
    train: int = 12,
    validation: int = 3,
    per_shard: int = 5,
    resolution: int = RESOLUTION,
    views: int = VIEWS,
) -> Dataset:
    """Write a dataset of toy samples as storage does, and open it."""
    layout = DatasetFolder(folder)
    index, shards = 0, []
    for split, count in (("train", train), ("validation", validation)):
        for number, start in enumerate(range(0, count, per_shard)):
            size = min(per_shard, count - start)
            samples = [
                toy_sample(index + row, resolution=resolution, views=views) for row in range(size)
            ]
            index += size
            path = layout.shard(f"{split}-{number:06d}.tar")
            write_shard(path, [(sample.key, encode_sample(sample)) for sample in samples])
            shards.append(index_shard(path))
    manifest = Manifest(
        build="toy",
        settings={"resolution": resolution, "scenes": {"max_triangles": 64}},
        environment={},
        num_scenes=index,
        num_views=views,
        objects_lock_sha256="",
        shards=tuple(shards),
    )
    write_manifest(layout.manifest, manifest)
    return open_dataset(str(folder))
