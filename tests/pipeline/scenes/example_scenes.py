"""RenderFormer's example scenes and a second reader of their OBJ files; a scene file of one box."""

import copy
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.from_description import (
    AlbedoOverOne,
    LoadedMesh,
    SceneDescription,
    scene_from_description,
)
from pipeline.exchange.renderformer_json import read_renderformer_json
from pipeline.exchange.scene_files import build_scene
from storage.records.scene import Scene
from trilight.compose import mesh_of_arrays

EXAMPLES = {
    "cbox": 4 * 128 + 2 * 2560 + 1,
    "cbox-bunny": 4 * 128 + 5696 + 1,
    "compose-scene": 128 + 224 + 2304 + 2072 + 2591 + 2,
    "crystals": 128 + 84 + 472 + 204 + 856 + 204 + 1,
    "init-template": 4 * 128 + 1,
    "tree": 3 * 128 + 4014 + 2,
}
"""Triangles of each scene: the faces of its OBJ files, counted with grep, a quad as two."""


@cache
def example_scene(shared: Path, name: str) -> Scene:
    """Return an example scene with the cameras of its file; nobody may change it."""
    loaded, _ = build_scene(
        (shared / "renderformer_scenes").resolve(),
        f"{name}.json",
        AssetSettings(),
        licence="LicenseRef-user-provided",
        num_views=1,
        scene_index=0,
        seed=0,
    )
    return loaded.scene


def plain_obj(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read an OBJ file by splitting lines: its vertices, and its faces cut into fans.

    A vertex stands once for every different corner that names it: a seam counts twice.
    """
    vertices: list[list[float]] = []
    rows: dict[str, int] = {}
    triangles = []
    for line in path.read_text().splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "f":
            ring = [rows.setdefault(word, len(rows)) for word in words]
            triangles += [[ring[0], ring[i], ring[i + 1]] for i in range(1, len(ring) - 1)]
    points = [vertices[int(word.split("/")[0]) - 1] for word in rows]
    return np.array(points), np.array(triangles)


def corners_of(scene: Scene, row: int) -> NDArray[np.float32]:
    """Return the corners [T, 3, 3] of one object of a scene."""
    return scene.vertex_positions[scene.faces[scene.object_index == row]]


OBJECT = {
    "mesh_path": "box.obj",
    "transform": {
        "translation": [0, 0, 0.5],
        "rotation": [0.0, 90.0, 0.0],
        "scale": [1.0, 2.0, 1.0],
        "normalize": False,
    },
    "material": {
        "diffuse": [0.5, 0.4, 0.3],
        "specular": [0.1, 0.1, 0.1],
        "roughness": 0.3,
        "emissive": [0.0, 0.0, 0.0],
        "smooth_shading": True,
        "rand_tri_diffuse_seed": None,
        "random_diffuse_max": 0.5,
        "random_diffuse_type": "per-triangle",
    },
}
SCENE = {
    "scene_name": "one box",
    "version": "1.0",
    "objects": {"box": OBJECT},
    "cameras": [{"position": [0, -2, 0], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}],
}


def changed(*path: str | int, **change: Any) -> bytes:
    """Return the scene with fields set, or removed where the value is Ellipsis, below `path`."""
    scene: Any = copy.deepcopy(SCENE)
    place = scene
    for step in path:
        place = place[step]
    for name, value in change.items():
        if value is ...:
            del place[name]
        else:
            place[name] = value
    return json.dumps(scene).encode()


BOX = ("objects", "box")
MATERIAL = (*BOX, "material")
TRANSFORM = (*BOX, "transform")
CAMERA = ("cameras", 0)


def described(*path: str | int, **change: Any) -> SceneDescription:
    """Return the description of the scene with a light, changed."""
    scene = json.loads(changed(*path, **change))
    light = json.loads(changed())["objects"]["box"]
    light["mesh_path"] = "light.obj"
    light["material"]["emissive"] = [10.0, 5.0, 0.0]
    light["transform"]["translation"] = [0, 0, 3]
    scene["objects"]["light"] = light
    return read_renderformer_json(json.dumps(scene).encode(), "a.json")


def loaded(mesh: trimesh.Trimesh, uid: str = "box.obj") -> LoadedMesh:
    return mesh_of_arrays(mesh.vertices, mesh.faces, uid=uid, licence="MIT")


def built(
    description: SceneDescription,
    mesh: LoadedMesh | None = None,
    light: LoadedMesh | None = None,
    albedo_over_one: AlbedoOverOne = "scale",
) -> Scene:
    mesh = mesh or loaded(trimesh.creation.box())
    light = light or loaded(
        trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False), "light.obj"
    )
    return scene_from_description(
        description,
        [mesh, light],
        num_views=1,
        provenance={},
        albedo_over_one=albedo_over_one,
    )
