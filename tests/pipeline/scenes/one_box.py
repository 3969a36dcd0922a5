"""A scene file of one box, to be changed, and its way to a scene without files."""

import copy
import json
from typing import Any

import numpy as np
import trimesh

from pipeline.exchange.from_description import (
    AlbedoOverOne,
    LoadedMesh,
    SceneDescription,
    scene_from_description,
)
from pipeline.exchange.renderformer_json import read_description
from storage.records.scene import Scene

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
    return read_description(json.dumps(scene).encode(), "a.json")


def loaded(mesh: trimesh.Trimesh, uid: str = "box.obj") -> LoadedMesh:
    points = np.asarray(mesh.vertices)
    centre = points.mean(axis=0)
    return LoadedMesh(
        uid=uid,
        licence="MIT",
        positions=points,
        faces=np.asarray(mesh.faces),
        centre=centre,
        reach=float(np.linalg.norm(points - centre, axis=1).max()),
    )


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
