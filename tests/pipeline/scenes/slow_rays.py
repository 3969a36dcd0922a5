"""Ray casting in ten plain lines of numpy: the slow twin of pipeline.scenes.sight."""

import numpy as np
from numpy.typing import NDArray

CHUNK = 64


def first_hits(
    origin: NDArray[np.float64], directions: NDArray[np.float64], triangles: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the first triangle (or -1) and the distance (or inf) of rays [N, 3] from one point.

    Moeller and Trumbore 1997, two-sided, double precision, every ray against every triangle.
    """
    face, distance = [], []
    a, ab, ac = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    for rays in np.array_split(directions, max(1, len(directions) // CHUNK)):
        p = np.cross(rays[:, None], ac[None])
        det = np.sum(p * ab, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.sum(p * (origin - a), axis=-1) / det
            q = np.cross(origin - a, ab)
            v = np.sum(rays[:, None] * q, axis=-1) / det
            t = np.sum(q * ac, axis=-1) / det
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        t = np.where(inside, t, np.inf)
        nearest = t.argmin(axis=1)
        reached = t[np.arange(len(rays)), nearest]
        face.append(np.where(np.isfinite(reached), nearest, -1))
        distance.append(reached)
    return np.concatenate(face), np.concatenate(distance)
