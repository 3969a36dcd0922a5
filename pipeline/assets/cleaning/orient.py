"""Outward orientation: faces agree with their neighbours, and patches with those who look at them.

Consistent winding comes first (libigl walks over the manifold edges); then every patch is turned so
that most rays from outside meet its front. It costs about as much as loading the file, and has to
come before decimation: a flipped face turns its edges into borders, which tear. An open sheet has
no outside; it gets the side that is seen more often, or keeps the one it has.
"""

import igl
import numpy as np
from embreex.mesh_construction import TriangleMesh as EmbreeMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from pipeline.assets.clean import canonical
from pipeline.assets.mesh import TriangleMesh

_DIRECTIONS = 24
_RAYS_PER_SIDE = 32
"""24 directions of 32 x 32 rays: the spacing is 5 % of the box, and each patch seen at all gets a
handful of votes. Patches that no ray meets fall back on the sign of their volume."""

_RADIUS = 0.9
"""Of a sphere around the unit box, whose corners are sqrt(3)/2 away from its centre."""


def orient_outward(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with faces counter-clockwise seen from outside, for one in the unit box.

    Their order is canonical again, so the result does not depend on the windings that came in.
    """
    faces, patch = igl.bfs_orient(np.ascontiguousarray(mesh.faces))
    turned = TriangleMesh(positions=mesh.positions, faces=faces)
    votes = _front_votes(turned, patch)
    volume = np.bincount(patch, weights=_signed_volume(turned, patch))
    flip = (votes < 0) | ((votes == 0) & (volume < 0))
    faces = np.where(flip[patch][:, None], faces[:, [0, 2, 1]], faces)
    return TriangleMesh(positions=mesh.positions, faces=canonical(faces))


def _front_votes(mesh: TriangleMesh, patch: NDArray[np.int64]) -> NDArray[np.float64]:
    """[P] rays from outside that meet the front of each patch first, less those at its back."""
    origins, directions = _outside_rays()
    scene = EmbreeScene()
    EmbreeMesh(scene, mesh.corners.astype(np.float32))
    face = scene.run(origins, directions)
    hit = face >= 0
    facing = np.einsum("ij,ij->i", mesh.double_area_vectors[face[hit]], directions[hit])
    votes = -np.sign(facing)
    seen = patch[face[hit]]
    return np.bincount(seen, weights=votes, minlength=int(patch.max()) + 1).astype(np.float64)


def _signed_volume(mesh: TriangleMesh, patch: NDArray[np.int64]) -> NDArray[np.float64]:
    """[F] volume of the tetrahedron between each face and the centre of its patch."""
    centres = mesh.corners.mean(axis=1)
    count = np.bincount(patch)
    middle = np.stack([np.bincount(patch, weights=axis) / count for axis in centres.T], axis=1)
    return np.einsum("ij,ij->i", mesh.double_area_vectors, centres - middle[patch]) / 6


def _outside_rays() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return origins and directions [R, 3]: parallel bundles from a Fibonacci sphere.

    No direction is an axis, so that boxes do not stand edge-on to a whole bundle.
    """
    index = np.arange(_DIRECTIONS) + 0.5
    z = 1 - 2 * index / _DIRECTIONS
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    side = np.cross(directions, np.roll(directions, 1, axis=1))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(directions, side)
    offset = _RADIUS * ((np.arange(_RAYS_PER_SIDE) + 0.5) / _RAYS_PER_SIDE * 2 - 1)
    plane = offset[:, None, None] * side[:, None, None] + offset[None, :, None] * up[:, None, None]
    origins = plane - 2 * _RADIUS * directions[:, None, None]
    spread = np.broadcast_to(directions[:, None, None], origins.shape)
    return origins.reshape(-1, 3).astype(np.float32), spread.reshape(-1, 3).astype(np.float32)
