"""Groups of lights: a network trained on few lights renders many, one group after the other.

Light is linear: the picture of a scene is the sum of its pictures by each group of lights alone. A
group's scene has no other emitter. This is exact except for light that emitters block and reflect,
which is little for a few small triangles (study S32). Keeping the others as black triangles is
worse, since emitters are hidden from the camera and black triangles are not.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.material import EMISSION
from storage.records.scene import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class LightGroup:
    """Scene with some of its lights, and the fraction of the light that they are."""

    scene: Scene
    """Scene with these lights only, scaled to the power of all lights: a tenth of the light would
    be darker than any training scene."""
    fraction: float
    """Factor of the group's picture in the sum, 0 to 1."""


def light_groups(scene: Scene, most: int) -> list[LightGroup]:
    """Return groups whose pictures, each times its fraction, add up to that of the scene.

    Emitting triangles that touch are one lamp and stay together, since the faces of a lamp block
    each other's light. Lamps within the bounding box of an object are never grouped with others,
    since networks are trained on lights outside of objects. Triangles without area emit no light
    and are left out.

    Args:
        scene: scene that passes `Scene.check`, without an environment.
        most: maximum number of emitting triangles of a group; only a single lamp may have more.

    Returns:
        The groups; a single one with the unchanged scene and a fraction of 1 if that suffices.
    """
    emitting_E = np.flatnonzero(scene.triangle_emits)
    if not len(emitting_E):
        return [LightGroup(scene=scene, fraction=1.0)]
    corners_E33 = scene.vertex_positions[scene.faces[emitting_E]].astype(np.float64)
    lamp_E = _lamps(corners_E33)
    groups = _pack_lamps(lamp_E, _is_inside(scene, corners_E33, lamp_E), most)
    a, b, c = np.moveaxis(corners_E33, 1, 0)
    area_E = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    emission_E3 = scene.materials[scene.material_index[emitting_E], EMISSION]
    power_E = area_E * emission_E3.mean(axis=1, dtype=np.float64)  # up to a constant factor
    powers = [float(power_E[np.isin(lamp_E, lamps)].sum()) for lamps in groups]
    if len(groups) == 1 or not any(powers):
        return [LightGroup(scene=scene, fraction=1.0)]
    lit_groups = [
        (lamps, power / sum(powers)) for lamps, power in zip(groups, powers, strict=True) if power
    ]
    return [
        _group(scene, emitting_E[~np.isin(lamp_E, lamps)], share) for lamps, share in lit_groups
    ]


def _lamps(corners_E33: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the lamp of each triangle: the lowest index among its connected triangles."""
    points, point_E3 = np.unique(corners_E33.reshape(-1, 3), axis=0, return_inverse=True)
    point_E3 = point_E3.reshape(-1, 3)
    lamp_E = np.arange(len(corners_E33))
    while True:
        least = np.full(len(points), len(lamp_E))
        np.minimum.at(least, point_E3, lamp_E[:, None])
        now_E = least[point_E3].min(axis=1)
        if np.array_equal(now_E, lamp_E):
            return lamp_E
        lamp_E = now_E


def _is_inside(
    scene: Scene, corners_E33: NDArray[np.float64], lamp_E: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return for each lamp whether its center is in the bounding box of an object."""
    count_E = np.maximum(np.bincount(lamp_E, minlength=len(lamp_E)), 1)
    middle_E3 = np.zeros((len(lamp_E), 3))
    np.add.at(middle_E3, lamp_E, corners_E33.mean(axis=1))
    middle_E3 /= count_E[:, None]
    rows = len(scene.objects)
    low = np.full((rows, 3), np.inf)
    high = np.full((rows, 3), -np.inf)
    corners_T33 = scene.vertex_positions[scene.faces]
    np.minimum.at(low, scene.object_index, corners_T33.min(axis=1))
    np.maximum.at(high, scene.object_index, corners_T33.max(axis=1))
    is_inside = np.zeros(len(lamp_E), bool)
    for row, entry in enumerate(scene.objects):
        if entry.kind == "object":
            is_inside |= ((low[row] <= middle_E3) & (middle_E3 <= high[row])).all(axis=1)
    return is_inside


def _pack_lamps(
    lamp_E: NDArray[np.int64], is_inside: NDArray[np.bool_], most: int
) -> list[list[int]]:
    """Return the lamps in their order, packed greedily into groups."""
    lamps, counts = np.unique(lamp_E, return_counts=True)
    groups = list[list[int]]()
    for where in (False, True):
        room = 0
        for lamp, count in zip(lamps, counts, strict=True):
            if is_inside[lamp] != where:
                continue
            if count > room:
                groups.append([])
                room = most
            groups[-1].append(int(lamp))
            room -= count
    return groups


def _group(scene: Scene, removed_faces: NDArray[np.int64], fraction: float) -> LightGroup:
    materials = scene.materials.copy()
    materials[:, EMISSION] /= fraction
    alone = dataclasses.replace(
        scene,
        faces=np.delete(scene.faces, removed_faces, axis=0),
        material_index=np.delete(scene.material_index, removed_faces),
        object_index=np.delete(scene.object_index, removed_faces),
        materials=materials,
    )
    return LightGroup(scene=alone, fraction=fraction)
