"""`TriangleMesh`: the arrays that the steps of this stage hand to one another."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleMesh:
    """Triangles as they are worked on: double precision, signed indices."""

    positions: NDArray[np.float64]
    """[V, 3]; the units of the source before `normalise`, the unit box after it."""
    faces: NDArray[np.int64]
    """[F, 3] rows of `positions`."""

    @property
    def corners(self) -> NDArray[np.float64]:
        """[F, 3, 3] the three positions of every face."""
        return self.positions[self.faces]

    @property
    def double_area_vectors(self) -> NDArray[np.float64]:
        """[F, 3] normal of every face, as long as twice its area."""
        corners = self.corners
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.positions, axis=0)))
