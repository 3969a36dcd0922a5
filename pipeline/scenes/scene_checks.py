"""Checks a composed scene; an invalid one is rejected, and its next attempt is tried.

Each camera has been checked before, by itself (`views`).
"""

import numpy as np
from numpy.typing import NDArray

from scene_templates.settings import SceneSettings
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene


def require_valid(scene: Scene, settings: SceneSettings, *, in_budget: bool = True) -> None:
    """Raise Rejected if a scene is invalid, over its budget, or has a light within an object.

    Args:
        scene: the scene to check.
        settings: the limits.
        in_budget: True to limit the number of triangles too.

    Raises:
        Rejected: "law_broken" with the message of `Scene.check`, "over_budget", or
            "emitter_inside" if an emitter reaches into the bounding box of an object.
    """
    try:
        scene.check()
    except TrilightError as error:
        uids = {entry.uid for entry in scene.objects if entry.uid} | {
            *scene.provenance.get("maps", ())
        }
        named = ", ".join(sorted(uids)) or "none"
        raise Rejected("law_broken", f"{error} Its objects and maps are {named}.") from error
    if in_budget and scene.num_triangles > settings.max_triangles:
        message = f"{scene.num_triangles} triangles; at most {settings.max_triangles} were allowed"
        raise Rejected("over_budget", message)
    _require_emitters_outside(scene, settings.lights.num_inside)


def _require_emitters_outside(scene: Scene, num_inside: int) -> None:
    boxes = object_boxes(scene)
    lamps = [row for row, entry in enumerate(scene.objects) if entry.is_lamp]
    for row in lamps[num_inside:]:
        low, high = _box(scene, row)
        if ((low < boxes[:, 1]) & (boxes[:, 0] < high)).all(axis=1).any():
            name = scene.objects[row].name
            raise Rejected("emitter_inside", f"{name} reaches into the box of an object")


def object_boxes(scene: Scene) -> NDArray[np.float32]:
    """Return the bounding boxes [K, 2, 3] of objects, without shell and emitters."""
    rows = [row for row, entry in enumerate(scene.objects) if entry.kind == "object"]
    return np.array([_box(scene, row) for row in rows], np.float32).reshape(-1, 2, 3)


def _box(scene: Scene, row: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    points = scene.vertex_positions[scene.faces[scene.object_index == row].ravel()]
    return points.min(axis=0), points.max(axis=0)
