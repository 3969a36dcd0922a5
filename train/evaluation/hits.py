"""Which pixels look at geometry: every ray against every triangle, in three matrix products.

A ray from the camera's origin meets the triangle (a, b, c), given relative to that origin, exactly
where its direction is a combination of a, b and c with positive weights. Brute force: 64 x 64 rays
of 32 views and 1536 triangles take a few seconds; for many large pictures it would be too slow.
"""

import numpy as np
from numpy.typing import NDArray

from storage.conventions import camera_rays
from storage.records.scene import Scene

CHUNK = 256
"""Triangles at a time, which bounds memory at R * R * CHUNK numbers a product."""


def hit_masks(scene: Scene, resolution: int) -> NDArray[np.bool_]:
    """Return [V, R, R]: whether the ray through the pixel's centre hits a triangle.

    Emitters do not count, as they are hidden from the camera.
    """
    corners = scene.vertex_positions[scene.faces[~scene.triangle_emits]].astype(np.float64)
    masks = [
        _hits(corners, *camera_rays(c2w, float(fov_deg), resolution))
        for c2w, fov_deg in zip(scene.c2w, scene.fov_deg, strict=True)
    ]
    return np.stack(masks)


def _hits(corners_T33: NDArray, origin_3: NDArray, directions_RR3: NDArray) -> NDArray[np.bool_]:
    rays = directions_RR3.reshape(-1, 3)
    hit = np.zeros(len(rays), bool)
    for start in range(0, len(corners_T33), CHUNK):
        a, b, c = np.moveaxis(corners_T33[start : start + CHUNK] - origin_3, 1, 0)
        faces_origin = np.sign(np.einsum("ti,ti->t", a, np.cross(b, c)))
        inside = faces_origin != 0
        all_positive = np.broadcast_to(inside, (len(rays), len(a)))
        for first, second in ((b, c), (c, a), (a, b)):
            weight = rays @ np.cross(first, second).T * faces_origin
            all_positive = all_positive & (weight >= 0)
        hit |= all_positive.any(axis=1)
    return hit.reshape(directions_RR3.shape[:2])
