"""Shading normals and shading groups, and faces that have an area.

Flat faces get three vertices each. Smooth shading joins faces across edges below an angle into
shading groups; a vertex has one normal per group, so that a cube stays a cube and a sphere becomes
round. Normals weigh each face by its angle at the vertex, which makes them independent of how a
flat region is cut into triangles.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAST_FACING = 0.1
"""Least cosine between the normals of a corner and of its face. Below it the corner gets the normal
of its face, because seen from in front it would be shaded as if seen from behind."""


SMALLEST_DOUBLE_AREA = 1e-12
"""A triangle of a square micrometre: no ray meets it, and its normal is rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ShadedMesh:
    """A mesh with one normal per vertex."""

    positions: NDArray[np.float32]
    """[V, 3] vertices in the space of the input."""
    normals: NDArray[np.float32]
    """[V, 3] unit vectors, one for each vertex."""
    faces: NDArray[np.uint32]
    """[T, 3] rows of the three vertices."""
    groups: NDArray[np.int64]
    """[T] shading group, numbered from 0; all 0 where the mesh is flat."""


def flat_shaded(positions: NDArray[np.float32], faces: NDArray[np.uint32]) -> ShadedMesh:
    """Return the mesh with the geometric normal on every face; faces must have an area."""
    normals = face_normals(positions, faces)
    return ShadedMesh(
        positions=positions[faces].reshape(-1, 3),
        normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        faces=np.arange(3 * len(faces), dtype=np.uint32).reshape(-1, 3),
        groups=np.zeros(len(faces), np.int64),
    )


def smooth_shaded(
    positions: NDArray[np.float32], faces: NDArray[np.uint32], angle_deg: float
) -> ShadedMesh:
    """Return the mesh with normals interpolated across edges of at most `angle_deg`."""
    normals = face_normals(positions, faces)
    groups = shading_groups(faces, normals, angle_deg)
    corner_key = groups[:, None] * len(positions) + faces
    angles = _corner_angles(positions, faces)
    # the sum over all corners of the same key, for every corner
    _, row = np.unique(corner_key.ravel(), return_inverse=True)
    weighted = (normals[:, None] * angles[..., None]).reshape(-1, 3)
    sums = np.array([np.bincount(row, weights=column) for column in weighted.T], np.float64)
    corner_normals = sums.T[row].reshape(*faces.shape, 3)
    length = np.sqrt(np.sum(np.square(corner_normals), axis=-1))
    facing = np.einsum("tci,ti->tc", corner_normals, normals)
    turned_away = facing <= LEAST_FACING * length
    length[turned_away] = 1.0
    corner_normals = corner_normals / length[..., None]
    corner_normals[turned_away] = np.repeat(normals[:, None], 3, axis=1)[turned_away]
    # Such a corner becomes a vertex of its own, with a key that no other corner has.
    own_keys = corner_key.max() + 1 + np.arange(corner_key.size).reshape(-1, 3)
    keys = np.where(turned_away, own_keys, corner_key)
    _, first, vertex = np.unique(keys, return_index=True, return_inverse=True)
    return ShadedMesh(
        positions=positions[faces.ravel()[first]],
        normals=corner_normals.reshape(-1, 3)[first].astype(np.float32),
        faces=vertex.reshape(-1, 3).astype(np.uint32),
        groups=groups,
    )


def face_crosses(positions: NDArray[np.float32], faces: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return geometric normals [T, 3], each as long as twice the area of its face."""
    corners = positions.astype(np.float64)[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def face_normals(positions: NDArray[np.float32], faces: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return unit geometric normals [T, 3]; not finite for faces without area."""
    cross = face_crosses(positions, faces)
    return cross / np.sqrt(np.sum(np.square(cross), axis=1, keepdims=True))


def has_area(positions: NDArray[np.float32], faces: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Return a mask [F] of the faces that have an area after rounding to float32."""
    double_area = np.sqrt(np.sum(np.square(face_crosses(positions, faces)), axis=1))
    return np.asarray(double_area > SMALLEST_DOUBLE_AREA)


def shading_groups(
    faces: NDArray[np.uint32], normals: NDArray[np.float64], angle_deg: float
) -> NDArray[np.int64]:
    """Return the group [T] of each face: connected through shared edges of at most `angle_deg`.

    An edge of more than two faces, or of two faces with opposite orientation, is always sharp.
    """
    from trimesh.graph import connected_component_labels, face_adjacency  # late: slow to load

    pairs = face_adjacency(faces)
    cosine = np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1)
    smooth_pairs = pairs[cosine >= math.cos(math.radians(angle_deg))]
    return np.asarray(connected_component_labels(smooth_pairs, len(faces)), np.int64)


def _corner_angles(
    positions: NDArray[np.float32], faces: NDArray[np.uint32]
) -> NDArray[np.float64]:
    """Return the inner angle [T, 3] of each corner, radians."""
    corners = positions.astype(np.float64)[faces]
    forward = np.roll(corners, -1, axis=1) - corners
    backward = np.roll(corners, 1, axis=1) - corners
    across = np.sqrt(np.sum(np.square(np.cross(forward, backward)), axis=-1))
    return np.arctan2(across, np.sum(forward * backward, axis=-1))
