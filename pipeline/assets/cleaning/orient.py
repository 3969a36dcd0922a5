"""Outward orientation: consistent winding of each patch, then a vote of rays on its front.

Consistent winding comes first (libigl walks over the manifold edges); then every patch is flipped
where most rays from outside hit its back. It costs about as much as loading the file, and must come
before decimation: a flipped face turns its edges into borders, which tear. An open sheet has no
outside; its front becomes the side that more rays hit, or stays.
"""

import igl
import numpy as np
from numpy.typing import NDArray

from pipeline.assets.cleaning.clean import canonical
from pipeline.assets.outside_rays import first_faces, outside_rays
from pipeline.foreign.mesh import TriangleMesh

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
    volume = np.bincount(patch, weights=_signed_volume(turned, patch))
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
    return np.stack(
        [
            np.bincount(seen[facing < 0], minlength=num_patches),
            np.bincount(seen[facing > 0], minlength=num_patches),
        ]
    )


def _signed_volume(mesh: TriangleMesh, patch: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return [F] volumes of the tetrahedra between each face and the center of its patch."""
    centres = mesh.corners.mean(axis=1)
    count = np.bincount(patch)
    middle = np.stack([np.bincount(patch, weights=axis) / count for axis in centres.T], axis=1)
    return np.einsum("ij,ij->i", mesh.double_area_vectors, centres - middle[patch]) / 6
