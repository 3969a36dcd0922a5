"""The triangles that cameras see, prepared for rays: everybody's way to Embree.

Emitters are left out, since they are hidden from camera rays in the pictures too; rays pass through
them. Embree works in single precision, here in its robust mode, in which no ray slips between two
triangles of one edge. Only `pipeline.assets.outside_rays` asks Embree by itself: it has no scene.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.records.scene import Scene

MISS = -1
"""Triangle and object of a ray that meets nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MetSurfaces:
    """What N rays meet first, in Embree's own precision."""

    triangle: NDArray[np.int64]
    """[N] row of `Scene.faces`, or MISS."""
    distance_m: NDArray[np.float32]
    """[N] along the ray, in lengths of its direction; beyond all measure where nothing is met."""
    normal: NDArray[np.float32]
    """[N, 3] of the triangle's plane, in world space, of any length, towards the side from which
    its corners run counter-clockwise; undefined where nothing is met."""


class Surfaces:
    """The triangles of a scene that do not emit."""

    def __init__(self, scene: Scene) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._rows = np.flatnonzero(~scene.triangle_emits)
        self._embree = EmbreeScene(robust=True)
        TriangleMesh(self._embree, scene.vertex_positions, scene.faces[self._rows])

    def met(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> MetSurfaces:
        """Return what rays [N, 3] from `origins` [N, 3] meet first, from either side."""
        found = self._embree.run(origins, directions, output=True)
        rows = np.append(self._rows, MISS)  # the last one, which -1 picks
        return MetSurfaces(
            triangle=rows[found["primID"]], distance_m=found["tfar"], normal=found["Ng"]
        )

    def is_free(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        distances_m: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""
        found = self._embree.run(origins, directions, dists=distances_m, query="OCCLUDED")
        free: NDArray[np.bool_] = np.asarray(found) < 0
        return free
