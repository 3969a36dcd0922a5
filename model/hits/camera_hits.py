"""First hits of a camera's rays: the triangle of each, and the position on it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.hits.camera import Rays
from model.hits.lit_scene import LitScene
from model.hits.second_hits import blocks
from model.hits.vectors import Floats


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
