"""Outward orientation: faces agree with their neighbours, and patches with those who look at them.

Consistent winding comes first (libigl walks over the manifold edges); then every patch is turned so
that most rays from outside meet its front. It costs about as much as loading the file, and has to
come before decimation: a flipped face turns its edges into borders, which tear. An open sheet has
no outside; it gets the side that is seen more often, or keeps the one it has.
"""

import igl
import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import canonical
from pipeline.assets.outside_rays import first_faces, outside_rays
from pipeline.foreign.mesh import TriangleMesh

_DIRECTIONS = 24
_RAYS_PER_SIDE = 32
"""24 directions of 32 x 32 rays: the spacing is 5 % of the box, and each patch seen at all gets a
handful of votes. Patches that no ray meets fall back on the sign of their volume."""


def orient_outward(mesh: TriangleMesh) -> tuple[TriangleMesh, float]:
    """Return a mesh of the unit box with faces counter-clockwise seen from outside, and how sure.

    Their order is canonical again, so the result does not depend on the windings that came in. The
    number is the share of rays from outside that meet a front: 1 for a closed surface, about a half
    for a flat sheet, which has no outside.
    """
    faces, patch = igl.bfs_orient(np.ascontiguousarray(mesh.faces))
    turned = TriangleMesh(positions=mesh.positions, faces=faces)
    votes = _front_votes(turned, patch)
    volume = np.bincount(patch, weights=_signed_volume(turned, patch))
    flip = (votes[0] < votes[1]) | ((votes[0] == votes[1]) & (volume < 0))
    faces = np.where(flip[patch][:, None], faces[:, [0, 2, 1]], faces)
    fronts = float(np.where(flip, votes[1], votes[0]).sum())
    hits = float(votes.sum())
    oriented = TriangleMesh(positions=mesh.positions, faces=canonical(faces))
    return oriented, fronts / hits if hits else 0.0


def _front_votes(mesh: TriangleMesh, patch: NDArray[np.int64]) -> NDArray[np.int64]:
    """[2, P] rays from outside that meet the front of each patch first, and those at its back."""
    origins, directions = outside_rays(_DIRECTIONS, _RAYS_PER_SIDE)
    face = first_faces(mesh, origins, directions)
    hit = face >= 0
    facing = np.einsum("ij,ij->i", mesh.double_area_vectors[face[hit]], directions[hit])
    seen = patch[face[hit]]
    num_patches = int(patch.max()) + 1
    return np.stack(
        [
            np.bincount(seen[facing < 0], minlength=num_patches),
            np.bincount(seen[facing > 0], minlength=num_patches),
        ]
    )


def _signed_volume(mesh: TriangleMesh, patch: NDArray[np.int64]) -> NDArray[np.float64]:
    """[F] volume of the tetrahedron between each face and the centre of its patch."""
    centres = mesh.corners.mean(axis=1)
    count = np.bincount(patch)
    middle = np.stack([np.bincount(patch, weights=axis) / count for axis in centres.T], axis=1)
    return np.einsum("ij,ij->i", mesh.double_area_vectors, centres - middle[patch]) / 6
