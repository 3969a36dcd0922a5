"""A small dataset with analytic pictures: floor, boxes, one coloured light, no shadows.

Real enough to learn from and made in milliseconds. All that a scene holds shows in its pictures,
which would else prove nothing of it: every second box has interpolated normals, surfaces shine by
Blinn and Phong over Lambert, the light has a colour, and cameras are tilted.
"""

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage.conventions import camera_rays, look_at_c2w
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.records.material import DIFFUSE, ROUGHNESS, SPECULAR, completed_rows
from storage.records.material import EMISSION as EMITTED
from storage.records.sample import Sample, ViewRecord, encode_sample, sample_key
from storage.records.scene import Scene, SceneObject
from storage.seeds import rng_for

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
SIDES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)
LIGHT = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, -0.1, 0]])
EMISSION = np.array([24.0, 20.0, 16.0])
RESOLUTION = 32
VIEWS = 2


def toy_scene(index: int, *, views: int = VIEWS, boxes: int | None = None) -> Scene:
    rng, shine = rng_for(5, "toy", index), rng_for(5, "toy shine", index)
    quads = [np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])]
    middles = []
    for _ in range(boxes if boxes is not None else int(rng.integers(1, 4))):
        middles.append(np.array([*rng.uniform(-0.3, 0.3, 2), 0.2]))
        quads += list((CORNERS * rng.uniform(0.08, 0.18, 3) + middles[-1])[SIDES])
    corners = np.concatenate([quad[[[0, 1, 2], [0, 2, 3]]] for quad in quads])
    light = LIGHT + np.array([*rng.uniform(-1, 1, 2), 1.5])
    corners = np.concatenate([corners, light[None]])
    num_objects = (len(quads) - 1) // 6 + 2
    owner = np.array([0, 0, *np.repeat(np.arange(1, num_objects - 1), 12), num_objects - 1])
    materials = np.zeros((num_objects, 10), np.float32)
    materials[:-1, DIFFUSE] = rng.uniform(0.1, 0.9, (num_objects - 1, 3))
    materials[:-1, SPECULAR] = shine.uniform(0, 0.1, (num_objects - 1, 3))
    materials[:, ROUGHNESS] = shine.uniform(0.3, 0.8, num_objects)
    materials[-1, EMITTED] = EMISSION
    kinds = ["shell", *["object"] * (num_objects - 2), "emitter"]
    ups = np.column_stack([shine.uniform(-0.1, 0.1, (views, 2)), np.ones(views)])
    poses = [
        look_at_c2w(eye=eye, target=[0, 0, 0.1], up=up)
        for eye, up in zip(_eyes(rng, views), ups, strict=True)
    ]
    return Scene(
        vertex_positions=corners.reshape(-1, 3).astype(np.float32),
        vertex_normals=_normals(corners, owner, middles).reshape(-1, 3).astype(np.float32),
        faces=np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3),
        material_index=owner.astype(np.uint16),
        materials=completed_rows(materials, None),
        object_index=owner.astype(np.uint16),
        c2w=np.stack(poses).astype(np.float32),
        fov_deg=rng.uniform(35, 55, views).astype(np.float32),
        objects=tuple(
            SceneObject(name=f"{kind}{row}", kind=kind)  # type: ignore[arg-type]
            for row, kind in enumerate(kinds)
        ),
        provenance={"template": "toy", "scene": index},
    )


def _normals(corners: NDArray, owner: NDArray, middles: list[NDArray]) -> NDArray:
    """Return [T, 3, 3]: of the first box and every second one, away from its middle."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.repeat(across[:, None], 3, axis=1)
    for row, middle in enumerate(middles):
        if row % 2 == 0:
            normals[owner == row + 1] = corners[owner == row + 1] - middle
    return _unit(normals)


def _unit(vectors: NDArray) -> NDArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _eyes(rng: np.random.Generator, views: int) -> NDArray:
    azimuth = rng.uniform(0, 2 * np.pi, views)
    return np.stack([1.6 * np.cos(azimuth), 1.6 * np.sin(azimuth), rng.uniform(0.5, 1.2, views)], 1)


def toy_picture(scene: Scene, view: int, resolution: int) -> NDArray[np.float32]:
    """Return [R, R, 3]: the nearest triangle under one point light, black background."""
    origin, rays = camera_rays(scene.c2w[view], float(scene.fov_deg[view]), resolution)
    corners = scene.vertex_positions[scene.faces].astype(np.float64)
    lit = ~scene.triangle_emits
    light = corners[~lit][0].mean(axis=0)
    a, b, c = np.moveaxis(corners[lit], 1, 0)
    across = np.cross(b - a, c - a)
    normal = _unit(across)
    weights = []
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = ((a - origin) * normal).sum(1) / (rays @ normal.T)
        point = origin + depth[..., None] * rays[:, :, None]
        for first, second in ((b, c), (c, a), (a, b)):
            side = np.cross(second - first, point - first)
            weights.append((side * across).sum(-1) / (across * across).sum(-1))
    weight = np.stack(weights, axis=-1)
    depth = np.where((depth > 0) & (weight >= 0).all(axis=-1), depth, np.inf)
    nearest = depth.argmin(axis=-1)
    hit = np.isfinite(depth.min(axis=-1))
    weight = np.where(hit[..., None], _at(weight, nearest), 1)
    shading = (weight[..., None] * scene.vertex_normals[scene.faces][lit][nearest]).sum(axis=2)
    to_light = light - np.where(hit[..., None], _at(point, nearest), 0)
    falloff = hit / (to_light**2).sum(-1)
    shaded = _reflected(
        scene.materials[scene.material_index[lit]][nearest],
        _unit(shading),
        _unit(to_light),
        _unit(-rays),
    )
    emitted = scene.materials[scene.material_index[~lit]][0, EMITTED]
    return (0.2 * emitted * shaded * falloff[..., None]).astype(np.float32)


def _at(values: NDArray, nearest: NDArray) -> NDArray:
    """Return [R, R, 3] of [R, R, T, 3], each pixel's own triangle."""
    return np.take_along_axis(values, nearest[..., None, None], 2)[:, :, 0]


def _reflected(materials: NDArray, normal: NDArray, to_light: NDArray, to_eye: NDArray) -> NDArray:
    cosine = abs((normal * to_light).sum(-1, keepdims=True))
    gloss = abs((normal * _unit(to_light + to_eye)).sum(-1, keepdims=True))
    power = 2 / materials[..., [ROUGHNESS]].astype(np.float64) ** 2
    return np.asarray(materials[..., DIFFUSE] * cosine + materials[..., SPECULAR] * gloss**power)


def toy_sample(index: int, *, resolution: int = RESOLUTION, views: int = VIEWS) -> Sample:
    return toy_sample_of(toy_scene(index, views=views), index, resolution)


def toy_sample_of(scene: Scene, index: int, resolution: int = RESOLUTION) -> Sample:
    views = scene.num_views
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
    scene_of: Callable[[int], Scene] | None = None,
) -> Dataset:
    """Write a dataset of toy samples, or of other scenes, as storage does, and open it."""
    scene_of = scene_of or functools.partial(toy_scene, views=views)
    layout = DatasetFolder(folder)
    index, shards = 0, []
    for split, count in (("train", train), ("validation", validation)):
        for number, start in enumerate(range(0, count, per_shard)):
            size = min(per_shard, count - start)
            samples = [
                toy_sample_of(scene_of(index + row), index + row, resolution) for row in range(size)
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
