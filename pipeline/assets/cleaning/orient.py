"""Outward orientation: consistent winding of each patch, then a vote of rays on its front.

Consistent winding comes first (libigl walks over the manifold edges); then every patch is flipped
where most rays from outside hit its back. It costs about as much as loading the file, and must come
before decimation: a flipped face turns its edges into borders, which tear. An open sheet has no
outside; its front becomes the side that more rays hit, or stays. The rays are parallel, from around
the unit box.
"""

import igl
import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import canonical
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


_DIRECTIONS = 24
_RAYS_PER_SIDE = 32
"""24 directions of 32 x 32 rays: the spacing is 5 % of the box, and each visible patch gets a
handful of votes. Patches that no ray hits fall back on the sign of their volume."""


def orient_outward(mesh: TriangleMesh) -> tuple[TriangleMesh, float]:
    """Return a mesh with faces counter-clockwise seen from outside, and its fraction of front hits.

    The order of faces is canonical again, so the result does not depend on the source's windings.
    The fraction counts rays from outside that hit a front: 1 for a closed surface, about a half for
    a flat sheet, which has no outside.
    """
    faces, patch = igl.bfs_orient(np.ascontiguousarray(mesh.faces))
    turned = TriangleMesh(positions=mesh.positions, faces=faces)
    votes = _front_votes(turned, patch)
    # volumes of the tetrahedra between each face and the center of its patch
    centers = turned.corners.mean(axis=1)
    sums = [np.bincount(patch, weights=axis) for axis in centers.T]
    middle = np.stack(sums, axis=1) / np.bincount(patch)[:, None]
    across = np.einsum("ij,ij->i", turned.double_area_vectors, centers - middle[patch]) / 6
    volume = np.bincount(patch, weights=across)
    flip = (votes[0] < votes[1]) | ((votes[0] == votes[1]) & (volume < 0))
    faces = np.where(flip[patch][:, None], faces[:, [0, 2, 1]], faces)
    fronts = float(np.where(flip, votes[1], votes[0]).sum())
    hits = float(votes.sum())
    oriented = TriangleMesh(positions=mesh.positions, faces=canonical(faces))
    return oriented, fronts / hits if hits else 0.0


def _front_votes(mesh: TriangleMesh, patch: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count [2, P] rays from outside that hit each patch first: at its front, at its back."""
    origins, directions = outside_rays(_DIRECTIONS, _RAYS_PER_SIDE)
    face = first_faces(mesh, origins, directions)
    hit = face >= 0
    facing = np.einsum("ij,ij->i", mesh.double_area_vectors[face[hit]], directions[hit])
    seen = patch[face[hit]]
    num_patches = int(patch.max()) + 1
    sides = (facing < 0, facing > 0)
    return np.stack([np.bincount(seen[side], minlength=num_patches) for side in sides])
