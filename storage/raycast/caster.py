"""`RayCaster`: which triangles rays meet, on the CPU or on a GPU.

Embree is its form for numpy; a kernel of model.hits is that for tensors. A `FirstHitCaster` is
enough for passes: Embree, or Mitsuba on a GPU (pipeline.renders.kernel_scene).
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from storage.records.scene import Scene

MISS = -1
"""Triangle and object of a ray that meets nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RayHits:
    """First hits of N rays; arrays of the caster's kind."""

    triangle: Any
    """[N] row of the triangle, or MISS; int64."""
    uv: Any
    """[2, N] weights of its second and third corner; undefined where nothing is met; float32."""


class FirstHitCaster(Protocol):
    """Some triangles of many, as rays meet them; arrays are of one kind, all float32."""

    def intersect(self, origins: Any, directions: Any) -> RayHits:
        """Return the first hits of rays [N, 3] from `origins` [N, 3], from either side."""


class RayCaster(FirstHitCaster, Protocol):
    """A caster that also says what is free, for shadows."""

    def is_free(self, origins: Any, directions: Any, distances_m: Any) -> Any:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MetSurfaces(RayHits):
    """First hits of N rays, in Embree's precision."""

    distance_m: NDArray[np.float32]
    """[N] along the ray, in lengths of its direction; beyond all measure where nothing is met."""
    normal: NDArray[np.float32]
    """[N, 3] of the triangle's plane, in world space, of any length, towards the side from which
    its corners run counter-clockwise; undefined where nothing is met."""


class Triangles:
    """Some triangles of many, as Embree's rays meet them: a `RayCaster`.

    Embree works in single precision, here in its robust mode, in which no ray slips between two
    triangles of one edge. `pipeline.assets.cleaning.orient` calls Embree itself, without a scene.
    """

    def __init__(self, corners_T33: NDArray[np.float32], rows: NDArray[np.intp]) -> None:
        """Take the corners of triangles, world space, and the rows of those that are there."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._rows = np.append(rows, MISS)  # the last one, which -1 picks
        self._embree = EmbreeScene(robust=True)
        if count := 3 * len(rows):
            faces = np.arange(count, dtype=np.uint32).reshape(-1, 3)
            TriangleMesh(self._embree, corners_T33[rows].reshape(count, 3), faces)

    def intersect(
        self, origins: NDArray[np.float32], directions: NDArray[np.float32]
    ) -> MetSurfaces:
        """Return the first hits of rays [N, 3] from `origins` [N, 3], from either side."""
        hits = self._embree.run(origins, directions, output=True)
        return MetSurfaces(
            triangle=self._rows[hits["primID"]],
            uv=np.stack([hits["u"], hits["v"]]),
            distance_m=hits["tfar"],
            normal=hits["Ng"],
        )

    def is_free(
        self,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        distances_m: NDArray[np.float32],
    ) -> NDArray[np.bool_]:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""
        occluder = self._embree.run(origins, directions, dists=distances_m, query="OCCLUDED")
        return np.asarray(occluder) < 0


class Surfaces(Triangles):
    """The triangles of a scene that cameras see.

    Emitters are left out, since they are hidden from camera rays in the pictures too; rays pass
    through them.
    """

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene.vertex_positions[scene.faces], np.flatnonzero(~scene.triangle_emits))
