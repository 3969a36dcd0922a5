"""Edits of a scene in the page: positions and brightness of lamps, and materials.

The page holds the edits and sends all of them with every request; the loaded scene stays unchanged,
so that nothing has to be undone.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.retextured import chosen_maps
from storage.records.scene import MAX_POSITION_M, Scene
from storage.records.texture import CONSTANT, TEXTURED

MOST_GAIN = 1000.0
"""Maximum factor by which a lamp may become brighter."""

_COLUMNS = {"diffuse": DIFFUSE, "specular": SPECULAR}


def apply_edits(scene: Scene, edits: Mapping[str, Any]) -> Scene:
    """Return the scene with edits.

    Args:
        scene: scene as it was loaded.
        edits: `lamps`: by row of the emitter, `move` [3] in meters and `gain`; `materials`: by row,
            `diffuse` and `specular` [3] and `roughness`. Values that are left out stay. A stated
            color or number replaces a texture.

    Raises:
        TrilightError: an edit is malformed, or breaks a rule of scenes.
    """
    lamps = _group(edits, "lamps")
    materials = _group(edits, "materials")
    if not lamps and not materials:
        return scene
    positions = scene.vertex_positions.copy()
    rows = scene.materials.copy()
    worn = None if scene.material_textures is None else scene.material_textures.copy()
    for row, change in lamps.items():
        _move_lamp(scene, row, change, positions, rows)
    for row, change in materials.items():
        _change_material(scene, row, change, rows, worn)
    worn_scene = dataclasses.replace(scene, material_textures=worn)
    every = (np.arange(scene.num_triangles), np.arange(len(rows)))
    changed = dataclasses.replace(
        scene, vertex_positions=positions, materials=rows, **chosen_maps(worn_scene, *every)
    )
    changed.check()
    return changed


def _group(edits: Mapping[str, Any], name: str) -> dict[int, Mapping[str, Any]]:
    changes = edits.get(name, {})
    try:
        group = {int(row): dict(change) for row, change in changes.items()}
    except (AttributeError, TypeError, ValueError) as error:
        raise TrilightError(f"edits: {name} is no table of changes by row.") from error
    return dict(group)


def _move_lamp(
    scene: Scene,
    row: int,
    change: Mapping[str, Any],
    positions: NDArray[np.float32],
    rows: NDArray[np.float32],
) -> None:
    if not 0 <= row < len(scene.objects) or scene.objects[row].kind != "emitter":
        raise TrilightError(f"edits: object {row} is no lamp of the scene.")
    mine = scene.object_index == row
    move = _numbers(change.get("move", (0, 0, 0)), "move", 3, -MAX_POSITION_M, MAX_POSITION_M)
    positions[np.unique(scene.faces[mine])] += move.astype(np.float32)
    gain = float(_numbers([change.get("gain", 1)], "gain", 1, 0.001, MOST_GAIN)[0])
    for material in np.unique(scene.material_index[mine]):
        rows[material, EMISSION] = scene.materials[material, EMISSION] * gain


def _change_material(
    scene: Scene,
    row: int,
    change: Mapping[str, Any],
    rows: NDArray[np.float32],
    worn: NDArray[np.int32] | None,
) -> None:
    if not 0 <= row < len(rows):
        raise TrilightError(f"edits: the scene has no material {row}.")
    for name, part in _COLUMNS.items():
        if name in change:
            rows[row, part] = _numbers(change[name], name, 3, 0, 1)
    if "roughness" in change:
        rows[row, ROUGHNESS] = _numbers([change["roughness"]], "roughness", 1, 0, 1)[0]
    if worn is not None:
        worn[row, [at for at, name in enumerate(TEXTURED) if name in change]] = CONSTANT


def _numbers(values: Any, name: str, count: int, low: float, high: float) -> NDArray[np.float64]:
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError) as error:
        raise TrilightError(f"edits: {name} is no list of numbers.") from error
    if len(numbers) != count or not all(math.isfinite(v) and low <= v <= high for v in numbers):
        raise TrilightError(
            f"edits: {name} is {numbers}; expected {count} from {low:g} to {high:g}."
        )
    return np.array(numbers)
