"""Scenes of the experiments: those of presets and of the user, and one for costs.

In the scene for costs one quantity at a time can be changed. Two built-in objects, a mirror and a
rough body, are in an open room of three quads under small lights. More or fewer triangles of the
objects come from the same formula; the lights are the first ones on a ring, and share one power. So
surfaces, materials and camera always agree.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipeline.exchange.formats import SceneSource
from pipeline.exchange.reader import SceneReader
from pipeline.generation.scene_worker import SceneWorker
from pipeline.isolation import IsolatedChild
from pipeline.objects.builtin.surfaces import superquadric
from pipeline.presets.settings import DatasetSettings
from pipeline.scenes.pieces import (
    ScenePiece,
    concatenate_pieces,
    emitter_piece,
    shell_piece,
    surface_piece,
)
from scene_templates.layout import Emitter, ShellPart, SurfaceLook
from storage.conventions import look_at_c2w
from storage.errors import TrilightError, prefix_errors
from storage.records.scene import Scene, SceneObject
from storage.seeds import rng_for


def given_scenes(folder: Path | None) -> Mapping[str, SceneSource]:
    """Return the scenes in the files of a folder by their names, without JSON files of other kinds.

    Raises:
        TrilightError: the folder holds no file of a scene.
    """
    if folder is None:
        return {}
    with prefix_errors("--scenes"), SceneReader() as reader:
        sources = reader.list_scenes(str(folder))
        scenes = {source.name: source for source in sources if _may_hold_a_scene(source.path)}
        if not scenes:
            raise TrilightError(
                f"{folder}: it holds no scene; expected RenderFormer scenes (*.json), glTF or USD."
            )
    return scenes


def _may_hold_a_scene(path: Path) -> bool:
    """Return False for JSON without objects or a camera, such as templates and lists."""
    if path.suffix.lower() != ".json":
        return True
    try:
        record = json.loads(path.read_bytes())
    except ValueError:
        return False
    return isinstance(record, dict) and bool(record.get("objects")) and bool(record.get("cameras"))


def preset_scene(
    child: IsolatedChild, preset: DatasetSettings, scene_index: int, num_views: int = 1
) -> Scene:
    """Return a scene of a preset, composed in a render child.

    Raises:
        Rejected: every attempt at it was rejected.
    """
    settings = dataclasses.replace(preset.scenes, num_views=num_views)
    return child.call_method(SceneWorker.compose_first, settings, scene_index)


_TOTAL_EMISSION = 3750.0
"""Radiance summed over the lights, in the middle of the range of dataset presets."""

_SMOOTH_ANGLE_DEG = 60.0
_ROOM: dict[str, ArrayLike] = {
    "floor": [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]],
    "wall0": [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.5], [-1.0, 1.0, 1.5]],
    "wall1": [[-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, 1.0, 1.5], [-1.0, -1.0, 1.5]],
}


def cost_scene(num_triangles: int, num_lights: int) -> Scene:
    """Return the scene with one camera.

    Args:
        num_triangles: approximate number of all triangles, within a tenth from 100 on.
        num_lights: emitting triangles, 1 or more.
    """
    rng = rng_for(0, "cost scene")
    shell = [
        shell_piece(quad(name, corners, plain_surface(0.5, 0.3, 0.5)), rng, _SMOOTH_ANGLE_DEG)
        for name, corners in _ROOM.items()
    ]
    for_objects = num_triangles - 2 * len(_ROOM) - num_lights
    objects = [
        _object(
            "box", 0.3, for_objects // 2, (0.35, 0.1, 0.36), plain_surface(0.05, 0.9, 0.05), rng
        ),
        _object("egg", 1.0, for_objects // 2, (-0.4, 0.0, 0.36), plain_surface(0.6, 0.3, 0.6), rng),
    ]
    emitters = [emitter_piece(_light(row, num_lights), row) for row in range(num_lights)]
    pose = look_at_c2w(eye=(1.4, -2.2, 1.3), target=(0, 0, 0.35), up=(0, 0, 1))
    provenance = {"template": "cost", "scene_index": 0, "attempt": 0, "seed": 0}
    return scene_of_pieces([*shell, *objects, *emitters], pose, 40.0, provenance)


def scene_of_pieces(
    pieces: Sequence[ScenePiece],
    pose: NDArray[np.float64],
    fov_deg: float,
    provenance: Mapping[str, Any],
) -> Scene:
    """Return a checked scene of pieces with one camera."""
    scene = Scene(
        **concatenate_pieces(pieces),
        c2w=pose[None].astype(np.float32),
        fov_deg=np.array([fov_deg], np.float32),
        objects=tuple(piece.entry for piece in pieces),
        provenance=provenance,
    )
    scene.check()
    return scene


def plain_surface(
    diffuse: float, specular: float, roughness: float, *, smooth: bool = True
) -> SurfaceLook:
    """Return a gray surface of one color."""
    return SurfaceLook(
        diffuse_scale=diffuse,
        diffuse_rgb=(diffuse, diffuse, diffuse),
        specular_rgb=(specular, specular, specular),
        roughness=roughness,
        smooth=smooth,
        colours="one",
    )


def quad(name: str, corners: ArrayLike, surface: SurfaceLook) -> ShellPart:
    """Return a part of the shell of two triangles; `corners` [4, 3] go around it."""
    return ShellPart(
        name=name,
        positions=np.asarray(corners, np.float64),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        surface=surface,
    )


def _object(
    name: str,
    exponent: float,
    num_triangles: int,
    centre: tuple[float, float, float],
    surface: SurfaceLook,
    rng: np.random.Generator,
) -> ScenePiece:
    """Return a superquadric of 2 rings columns triangles, near `num_triangles`."""
    rings = max(2, round(math.sqrt(num_triangles / 4)))
    columns = max(3, round(num_triangles / (2 * rings)))
    positions, faces = superquadric(
        exponent_profile=exponent,
        exponent_plan=exponent,
        half_sizes=(0.3, 0.3, 0.35),
        rings=rings,
        columns=columns,
    )
    placed: NDArray[np.float32] = (positions + np.array(centre)).astype(np.float32)
    entry = SceneObject(name=name, kind="object")
    return surface_piece(entry, placed, faces.astype(np.uint32), surface, rng, _SMOOTH_ANGLE_DEG)


def _light(row: int, num_lights: int) -> Emitter:
    """Return a position on a ring, in an order that spreads the first ones."""
    angle = 2 * math.pi * ((row * 0.6180339887) % 1.0)
    centre = np.array([0.8 * math.cos(angle), 0.8 * math.sin(angle) - 0.6, 2.2])
    corners = 0.08 * np.array([[1.0, 0.0, 0.0], [-0.5, -0.866, 0.0], [-0.5, 0.866, 0.0]])
    radiance = _TOTAL_EMISSION / num_lights
    return Emitter(
        triangle=centre + corners, radiance_rgb=(radiance, radiance, radiance), reflectance=0.0
    )
