"""`PixelCamera`: one pinhole and its pixel grid, which is all that a tracer knows of a view."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelCamera:
    """A square picture's camera, as storage.conventions means it."""

    c2w: NDArray[np.float64]
    """[4, 4] camera to world; looks along -Z with +Y up."""
    fov_deg: float
    """Full field of view, equal in width and height."""
    resolution: int
    """Width and height in pixels."""

    def at_scale(self, factor: float) -> "PixelCamera":
        """Return the camera that sees the same of a scene that is so many times as large."""
        c2w = self.c2w.copy()
        c2w[:3, 3] *= factor
        return replace(self, c2w=c2w)
