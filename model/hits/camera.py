"""The rays of a camera in single precision, all pixels at a time."""

import numpy as np
from numpy.typing import NDArray

from model.hits.vectors import Floats, unit
from storage.conventions import focal_px


class Rays:
    """rays_a_side^2 rays through every pixel, on a regular grid over its area."""

    def __init__(
        self, c2w: Floats, fov_deg: float | Floats, resolution: int, rays_a_side: int
    ) -> None:
        self.resolution = resolution
        self.rays_per_pixel = rays_a_side**2
        self.origin = c2w[:3, 3].astype(np.float32)
        self._axes = c2w[:3, :3].astype(np.float32)
        self._focal = focal_px(fov_deg, resolution).astype(np.float32)
        self._a_side = rays_a_side

    def direction(self, ray_index: int, pixels: NDArray[np.int64] | slice = slice(None)) -> Floats:
        """Return unit directions [3, P] of ray `ray_index` of pixels, counted row by row."""
        row, column = divmod(ray_index, self._a_side)
        count = np.arange(self.resolution, dtype=np.float32) - np.float32(self.resolution / 2)
        x = count + np.float32((column + 0.5) / self._a_side)
        y = -(count + np.float32((row + 0.5) / self._a_side))
        right, up, back = self._axes.T
        along = right[:, None, None] * x + up[:, None, None] * y[:, None]
        along -= (back * self._focal)[:, None, None]
        return unit(along.reshape(3, -1)[:, pixels])
