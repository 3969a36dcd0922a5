"""The rays of a camera in single precision, all pixels at a time, and their first hits."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.hits.lit_scene import LitScene
from model.hits.second_hits import blocks
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


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraHits:
    """The first hits of the rays of P pixels, each of which has K rays."""

    along: Floats
    """[K, 3, P] unit directions of the rays."""
    triangle: NDArray[np.intp]
    """[K, P] row of the triangle, or MISS."""
    uv: Floats
    """[2, K, P] weights of its second and third corner."""

    def only(self, part: slice) -> "CameraHits":
        """Return the hits of some pixels."""
        return CameraHits(
            along=self.along[:, :, part], triangle=self.triangle[:, part], uv=self.uv[:, :, part]
        )

    @property
    def coverage(self) -> Floats:
        """[P] share of each pixel's rays that meet something."""
        share: Floats = (self.triangle >= 0).sum(axis=0).astype(np.float32)
        return share / np.float32(len(self.triangle))


def camera_hits(scene: LitScene, rays: Rays) -> CameraHits:
    """Return the first hits of all rays of a camera; emitters are hidden from them."""
    along = np.stack([rays.direction(number) for number in range(rays.rays_per_pixel)])
    triangle: list[NDArray] = []
    uv: list[Floats] = []
    for part in blocks(scene, rays.resolution**2):
        directions = along[:, :, part].swapaxes(0, 1).reshape(3, -1)
        hits = scene.first_hits(rays.origin, directions)
        triangle.append(hits.triangle.reshape(rays.rays_per_pixel, -1))
        uv.append(hits.uv.reshape(2, rays.rays_per_pixel, -1))
    return CameraHits(
        along=along, triangle=np.concatenate(triangle, axis=1), uv=np.concatenate(uv, axis=2)
    )
