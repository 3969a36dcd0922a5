"""RenderFormer's example scenes, built in this process, and a second reader of their OBJ files."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.scene_files import build_scene
from storage.records.scene import Scene

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
    scene, _ = build_scene(
        (shared / "renderformer_scenes").resolve(),
        f"{name}.json",
        AssetSettings(),
        licence="LicenseRef-user-provided",
        num_views=1,
        scene_index=0,
        seed=0,
    )
    return scene


@dataclass(frozen=True, kw_only=True)
class PlainObj:
    """An OBJ file, read by splitting lines."""

    points: list[tuple[float, float, float]]
    """Its vertices, once for every different corner that names them: a seam counts twice."""
    triangles: list[list[tuple[float, float, float]]]
    """Its faces, cut into fans."""


def plain_obj(path: Path) -> PlainObj:
    """Read an OBJ file in the most obvious way."""
    vertices: list[tuple[float, float, float]] = []
    corners: dict[str, tuple[float, float, float]] = {}
    triangles = []
    for line in path.read_text().splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            x, y, z = words[:3]
            vertices.append((float(x), float(y), float(z)))
        elif kind == "f":
            ring = []
            for word in words:
                corners[word] = vertices[int(word.split("/")[0]) - 1]
                ring.append(corners[word])
            triangles += [[ring[0], ring[i], ring[i + 1]] for i in range(1, len(ring) - 1)]
    return PlainObj(points=list(corners.values()), triangles=triangles)


def corners_of(scene: Scene, row: int) -> NDArray[np.float32]:
    """Return the corners [T, 3, 3] of one object of a scene."""
    return scene.vertex_positions[scene.faces[scene.object_index == row]]
