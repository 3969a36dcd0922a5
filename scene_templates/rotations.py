"""Rotations: uniform ones for objects and emitters, Euler angles for the shell."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Orientation = Literal["uniform", "euler"]
"""`uniform` on SO(3), or three `euler` angles as published, which prefer the poles."""


def sample_rotation(rng: np.random.Generator, orientation: Orientation) -> NDArray[np.float64]:
    """Return a random rotation [3, 3] of the stated distribution, not only yaw."""
    if orientation == "euler":
        return rotation_xyz(rng.uniform(-180, 180, size=3))
    return uniform_rotation(rng)


def uniform_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a rotation matrix [3, 3], uniform on SO(3).

    A normalised Gaussian 4-vector is uniform on the unit quaternions. Three uniform Euler angles,
    as in the published recipes, would turn objects towards the poles too often.
    """
    quaternion = rng.standard_normal(4)
    w, x, y, z = quaternion / np.sqrt(np.sum(np.square(quaternion)))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_xyz(angles_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation [3, 3] about the world's X, then Y, then Z, by angles in degrees [3]."""
    (cx, cy, cz) = np.cos(np.radians(np.asarray(angles_deg, np.float64)))
    (sx, sy, sz) = np.sin(np.radians(np.asarray(angles_deg, np.float64)))
    return np.array(
        [
            [cy * cz, sx * sy * cz - cx * sz, cx * sy * cz + sx * sz],
            [cy * sz, sx * sy * sz + cx * cz, cx * sy * sz - sx * cz],
            [-sy, sx * cy, cx * cy],
        ]
    )


def rotate_points(
    points: NDArray[np.float64], rotation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return `points` [N, 3] turned by `rotation` [3, 3].

    By einsum rather than a matrix product: BLAS may sum in another order on another machine or
    with another number of threads, and scenes must be the same bytes.
    """
    return np.einsum("ij,nj->ni", rotation, points)
