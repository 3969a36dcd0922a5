"""What tests ask of a composed scene, in plain numpy."""

import hashlib
import json

import numpy as np
from numpy.typing import NDArray

from storage.records.scene import ARRAY_FIELDS, Scene


def digest(scene: Scene) -> str:
    """Return the sha256 over all that a scene holds."""
    sha = hashlib.sha256()
    for name in ARRAY_FIELDS:
        sha.update(getattr(scene, name).tobytes())
    sha.update(repr(scene.objects).encode())
    sha.update(json.dumps(dict(scene.provenance), sort_keys=True).encode())
    return sha.hexdigest()


def rows_of(scene: Scene, kind: str) -> list[int]:
    """Return the rows of `scene.objects` of a kind."""
    return [row for row, entry in enumerate(scene.objects) if entry.kind == kind]


def triangles_of(scene: Scene, row: int) -> NDArray[np.float64]:
    """Return the corners [T, 3, 3] of one object."""
    return scene.vertex_positions[scene.faces[scene.object_index == row]].astype(np.float64)


def points_of(scene: Scene, row: int) -> NDArray[np.float64]:
    """Return the distinct vertices [V, 3] of one object."""
    return np.unique(triangles_of(scene, row).reshape(-1, 3), axis=0)


def planes_of(scene: Scene) -> NDArray[np.float64]:
    """Return the inward plane [K, 4] of each shell part, the floor first."""
    rows = []
    for row in rows_of(scene, "shell"):
        vertex = scene.faces[scene.object_index == row][0, 0]
        normal = scene.vertex_normals[vertex].astype(np.float64)
        rows.append(np.append(normal, -normal @ scene.vertex_positions[vertex]))
    return np.array(rows)


def counts_of(scene: Scene) -> dict[str, int]:
    """Return the number of triangles of each kind."""
    kinds = np.array([entry.kind for entry in scene.objects])[scene.object_index]
    return {kind: int((kinds == kind).sum()) for kind in ("shell", "object", "emitter")}


def ray_distances(
    origins: NDArray[np.float64], directions: NDArray[np.float64], triangles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where rays [N, 3] meet triangles [T, 3, 3]: [N, T] in directions, inf for a miss.

    Moeller and Trumbore 1997, two-sided, double precision, every ray against every triangle.
    """
    a, ab, ac = triangles[:, 0], *(triangles[:, k] - triangles[:, 0] for k in (1, 2))
    found = [np.zeros((0, len(triangles)))]
    for rows in np.array_split(np.arange(len(origins)), len(origins) // 64 + 1):
        along, away = directions[rows, None], origins[rows, None] - a
        p, q = np.cross(along, ac[None]), np.cross(away, ab[None])
        det = np.sum(p * ab, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, t = (np.sum(x * y, axis=-1) / det for x, y in ((p, away), (along, q), (q, ac)))
            is_met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        found.append(np.where(is_met, t, np.inf))
    return np.concatenate(found)
