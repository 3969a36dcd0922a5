"""How far two surfaces are apart: both ways, by evenly spread points and exact distances.

The 99th percentile rather than the largest value, because one vertex rules the latter; rather than
the mean, because a mean accepts almost anything. What it cannot see is a part that holds less than
one percent of the area.
"""

import igl
import numpy as np
from numpy.typing import NDArray

from pipeline.assets.mesh import TriangleMesh


def sample_surface(mesh: TriangleMesh, uniform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points [N, 3] spread evenly by area: one from each of N equal shares of it.

    Args:
        mesh: at least one face with area.
        uniform: [N, 3] independent numbers in [0, 1).
    """
    total = np.cumsum(np.linalg.norm(mesh.double_area_vectors, axis=1))
    share = (np.arange(len(uniform)) + uniform[:, 0]) / len(uniform) * total[-1]
    face = np.minimum(np.searchsorted(total, share, side="right"), len(total) - 1)
    root = np.sqrt(uniform[:, 1])
    weights = np.stack([1 - root, root * (1 - uniform[:, 2]), root * uniform[:, 2]], axis=1)
    return np.einsum("ij,ijk->ik", weights, mesh.corners[face])


class Surface:
    """A surface that others are compared with; its points and search tree are made once."""

    def __init__(self, mesh: TriangleMesh, uniform: NDArray[np.float64]) -> None:
        """Sample `mesh`, and later whatever it is compared with, at `uniform` [N, 3]."""
        self.mesh = mesh
        self._uniform = uniform
        self._points = sample_surface(mesh, uniform)
        self._tree = igl.AABB()
        self._tree.init(mesh.positions, mesh.faces)

    def distances_to(self, other: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the distances from here to `other` and back, [N] each, as shares of the diagonal.

        The diagonal is that of this surface's bounding box.
        """
        there = igl.point_mesh_squared_distance(self._points, other.positions, other.faces)[0]
        points = sample_surface(other, self._uniform)
        back = self._tree.squared_distance(self.mesh.positions, self.mesh.faces, points)[0]
        return np.sqrt(there) / self.mesh.diagonal, np.sqrt(back) / self.mesh.diagonal

    def p99_to(self, other: TriangleMesh) -> float:
        """Return the larger 99th percentile of the two directions, as a share of the diagonal."""
        return float(max(np.percentile(way, 99) for way in self.distances_to(other)))
