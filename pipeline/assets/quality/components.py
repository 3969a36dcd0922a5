"""Lost components of a mesh: small ones escape every measure that averages over the area."""

import igl
import numpy as np
from numpy.typing import NDArray

from pipeline.assets.quality.distance import Surface
from pipeline.foreign.mesh import TriangleMesh

_OWN_SIZE = 0.25
"""A component is lost where most of its points are farther from the result than this fraction of
its size."""

_VISIBLE = 0.005
"""Distance that never counts as lost, as a fraction of the object's diagonal: a pixel or two."""


def label_components(mesh: TriangleMesh) -> NDArray[np.int64]:
    """Return the component [F] of each face; faces connect over edges."""
    return np.asarray(igl.facet_components(mesh.faces)[1], np.int64)


class Components:
    """The components of a source, and the sample points on each."""

    def __init__(self, surface: Surface) -> None:
        part = label_components(surface.mesh)
        self.count = int(part.max()) + 1
        self._part_of_point = part[surface.points.faces]
        self._extent = _diagonals(surface.mesh, part, self.count) / surface.mesh.diagonal

    def lost_area(self, distances: NDArray[np.float64]) -> float:
        """Return the fraction of the source's area in lost components.

        Args:
            distances: [N] from each sample point to the result, as a fraction of the diagonal.

        A component without a sample point (below about 1/8000 of the area) never counts as lost.
        """
        limit = np.maximum(_OWN_SIZE * self._extent, _VISIBLE)[self._part_of_point]
        far = np.bincount(self._part_of_point, weights=distances > limit, minlength=self.count)
        points = np.bincount(self._part_of_point, minlength=self.count)
        return float(points[2 * far > points].sum() / points.sum())


def _diagonals(mesh: TriangleMesh, part: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    """Return [P] diagonals of the bounding box of each component."""
    low = np.full((count, 3), np.inf)
    high = np.full((count, 3), -np.inf)
    for corner in mesh.corners.transpose(1, 0, 2):
        np.minimum.at(low, part, corner)
        np.maximum.at(high, part, corner)
    return np.linalg.norm(high - low, axis=1)
