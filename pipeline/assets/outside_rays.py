"""Parallel rays from around the unit box, and the faces that they hit first."""

import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from pipeline.foreign.mesh import TriangleMesh

RADIUS = 0.9
"""Radius of a sphere around the unit box, whose corners are sqrt(3)/2 from its center."""


def outside_rays(
    num_directions: int, rays_per_side: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return origins and directions [D x R x R, 3]: parallel bundles from a Fibonacci sphere.

    No direction is an axis, so that boxes do not stand edge-on to a whole bundle.
    """
    index = np.arange(num_directions) + 0.5
    z = 1 - 2 * index / num_directions
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    side = np.cross(directions, np.roll(directions, 1, axis=1))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(directions, side)
    offset = RADIUS * ((np.arange(rays_per_side) + 0.5) / rays_per_side * 2 - 1)
    plane = offset[:, None, None] * side[:, None, None] + offset[None, :, None] * up[:, None, None]
    origins = plane - 2 * RADIUS * directions[:, None, None]
    spread = np.broadcast_to(directions[:, None, None], origins.shape)
    return origins.reshape(-1, 3).astype(np.float32), spread.reshape(-1, 3).astype(np.float32)


def first_faces(
    mesh: TriangleMesh, origins: NDArray[np.float32], directions: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Return the face [R] that each ray hits first, from either side; -1 where it hits none.

    Computed in single precision: a ray may slip through the seam between two faces.
    """
    scene = EmbreeScene()
    EmbreeMesh(scene, mesh.corners.astype(np.float32))
    return np.asarray(scene.run(origins, directions), np.int64)
