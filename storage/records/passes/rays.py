"""`PassRays`: what the passes are computed from."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from storage.records.first_hits import FirstHits, corner_table
from storage.records.scene import Scene


@dataclass(frozen=True, eq=False)
class Later:
    """Another moment of a scene, or another camera, that `motion_px` leads to."""

    scene: Scene
    """Has the same triangles with their corners in the same order, possibly elsewhere."""
    view: int
    """Camera index in the later scene."""

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """[T + 1, 3, 3] positions in metres, the last row NaN."""
        return corner_table(self.scene, self.scene.vertex_positions)


@dataclass(frozen=True, kw_only=True, eq=False)
class PassRays:
    """Rays of a view, with what they meet."""

    hits: FirstHits
    c2w: NDArray[np.float64]
    """[4, 4] of the camera."""
    fov_deg: float
    resolution: int
    """Width and height of the picture in pixels, however many rays a pixel has."""
    later: Later | None
