"""`RayCaster`: which triangles rays meet, on the CPU or on a GPU.

Embree is its form for numpy (storage.raycast.embree); a kernel of model.hits is that for tensors.
"""

from dataclasses import dataclass
from typing import Any, Protocol

MISS = -1
"""Triangle and object of a ray that meets nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RayHits:
    """First hits of N rays; arrays of the caster's kind."""

    triangle: Any
    """[N] row of the triangle, or MISS; int64."""
    uv: Any
    """[2, N] weights of its second and third corner; undefined where nothing is met; float32."""


class RayCaster(Protocol):
    """Some triangles of many, as rays meet them; arrays are of one kind, all float32."""

    def intersect(self, origins: Any, directions: Any) -> RayHits:
        """Return the first hits of rays [N, 3] from `origins` [N, 3], from either side."""

    def is_free(self, origins: Any, directions: Any, distances_m: Any) -> Any:
        """Return [N] whether rays meet nothing up to a distance [N], in lengths of directions."""
