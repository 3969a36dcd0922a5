"""Two-way (Hausdorff) distance of two surfaces, by evenly spread points and exact distances.

The quality check uses the 99th percentile: one vertex decides the largest value, and a mean accepts
almost anything. A component with less than one percent of the area escapes it;
`MeasuredSource` checks those.
"""

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray

from pipeline.assets.quality.triangles import unit_normals
from pipeline.foreign.mesh import TriangleMesh


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfacePoints:
    """Points spread evenly over a surface."""

    positions: NDArray[np.float64]
    """[N, 3] positions, in the units of the mesh."""
    faces: NDArray[np.int64]
    """[N] face of each point."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Deviation:
    """Distances and angles between two surfaces, point by point."""

    to_other: NDArray[np.float64]
    """[N] distances from points of the first surface to the second, as fractions of the diagonal of
    the first one's bounding box."""
    from_other: NDArray[np.float64]
    """[N] distances from points of the second surface to the first, in the same unit."""
    angle_deg: NDArray[np.float64]
    """[N] angles between the normal at each point of the first surface and at the nearest point of
    the second; 0 to 90, because the nearest point of a thin wall may lie on its other side."""

    def two_way(self, percentile: float) -> float:
        """Return the larger of the two directions' percentiles."""
        both = (self.to_other, self.from_other)
        return max(float(np.percentile(distances, percentile)) for distances in both)


def sample_surface(mesh: TriangleMesh, uniform: NDArray[np.float64]) -> SurfacePoints:
    """Return N points spread evenly by area: one from each of N equal fractions of it.

    Args:
        mesh: at least one face with area.
        uniform: [N, 3] independent numbers in [0, 1).
    """
    total = np.cumsum(np.linalg.norm(mesh.double_area_vectors, axis=1))
    target = (np.arange(len(uniform)) + uniform[:, 0]) / len(uniform) * total[-1]
    face = np.minimum(np.searchsorted(total, target, side="right"), len(total) - 1)
    root = np.sqrt(uniform[:, 1])
    weights = np.stack([1 - root, root * (1 - uniform[:, 2]), root * uniform[:, 2]], axis=1)
    return SurfacePoints(positions=np.einsum("ij,ijk->ik", weights, mesh.corners[face]), faces=face)


class Surface:
    """The reference surface of comparisons, with its points and search tree."""

    def __init__(self, mesh: TriangleMesh, uniform: NDArray[np.float64]) -> None:
        """Sample `mesh`, and later each other surface, at `uniform` [N, 3]."""
        self.mesh = mesh
        self.points = sample_surface(mesh, uniform)
        self._uniform = uniform
        self._normals = unit_normals(mesh)
        self._tree = igl.AABB()
        self._tree.init(mesh.positions, mesh.faces)

    def hausdorff_deviation(self, other: TriangleMesh) -> Deviation:
        """Return the sampled Hausdorff distances to and from `other`, point by point."""
        points = self.points.positions
        squared, nearest, _ = igl.point_mesh_squared_distance(points, other.positions, other.faces)
        cosine = np.einsum(
            "ij,ij->i", self._normals[self.points.faces], unit_normals(other)[nearest]
        )
        back = self._tree.squared_distance(
            self.mesh.positions, self.mesh.faces, sample_surface(other, self._uniform).positions
        )[0]
        return Deviation(
            to_other=np.sqrt(squared) / self.mesh.diagonal,
            from_other=np.sqrt(back) / self.mesh.diagonal,
            angle_deg=np.degrees(np.arccos(np.minimum(np.abs(cosine), 1.0))),
        )
