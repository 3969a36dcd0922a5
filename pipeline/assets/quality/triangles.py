"""Measures of triangles: evenness, angles, and edges by their number of faces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.mesh import TriangleMesh


@dataclass(frozen=True, kw_only=True)
class EdgeCounts:
    """Numbers of edges by how many faces share them."""

    open: int
    """Edges of one face: the border of an open surface."""
    nonmanifold: int
    """Edges that three or more faces share."""
    most_faces: int
    """Largest number of faces that share one edge."""


def unit_normals(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Return the unit normal [F, 3] of each face; each must have an area."""
    vectors = mesh.double_area_vectors
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def round_digits(value: float) -> float:
    """Round a measure to six digits: more than it has, and short in a file."""
    return float(f"{value:.6g}")


def area_variation(mesh: TriangleMesh) -> float:
    """Return the standard deviation of the areas over their mean; 0 where all are equal."""
    areas = np.linalg.norm(mesh.double_area_vectors, axis=1)
    return float(areas.std() / areas.mean())


def smallest_angles_deg(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Return the smallest angle [F] of each face; 60 where it is equilateral."""
    edges = np.roll(mesh.corners, -1, axis=1) - mesh.corners
    lengths = np.sort(np.linalg.norm(edges, axis=2), axis=1)
    a, b, c = lengths.T  # the smallest angle lies opposite the shortest side
    cosine = (b * b + c * c - a * a) / (2 * b * c)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def count_edges(mesh: TriangleMesh) -> EdgeCounts:
    """Count the open and non-manifold edges."""
    ends = np.sort(half_edges(mesh), axis=1)
    shared = np.unique(ends[:, 0] * len(mesh.positions) + ends[:, 1], return_counts=True)[1]
    return EdgeCounts(
        open=int((shared == 1).sum()),
        nonmanifold=int((shared > 2).sum()),
        most_faces=int(shared.max()),
    )


def half_edges(mesh: TriangleMesh) -> NDArray[np.int64]:
    """Return the edges of each face in its direction: [3F, 2] rows of `positions`."""
    return mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def open_half_edges(mesh: TriangleMesh) -> NDArray[np.int64]:
    """Return the edges [E, 2] that no face has in the opposite direction."""
    edges = half_edges(mesh)
    count = len(mesh.positions)
    opposite = edges[:, 1] * count + edges[:, 0]
    return edges[~np.isin(edges[:, 0] * count + edges[:, 1], opposite)]
