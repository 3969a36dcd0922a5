"""Camera rays in single precision with their first hits, and anchors: a few places of a view.

At anchors the light of other surfaces is gathered by many rays. That light is smooth, so its value
between anchors may be mixed from theirs (as irradiance caching: Ward et al. 1988), and costs the
same for a picture of any width.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.hits.lit_scene import LitScene, PerPoint, Points
from model.hits.radiosity import SceneLight
from model.hits.second_hits import blocks, outgoing_radiance
from model.hits.vectors import Floats, cosine_direction, spread, unit
from storage.conventions import focal_px
from storage.seeds import rng_for


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
class CameraHits(PerPoint):
    """The first hits of the rays of P pixels, each of which has K rays."""

    along: Floats
    """[K, 3, P] unit directions of the rays."""
    triangle: NDArray[np.intp]
    """[K, P] row of the triangle, or MISS."""
    uv: Floats
    """[2, K, P] weights of its second and third corner."""

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


def anchor_pixels(coverage_RR: NDArray[np.float32], anchors_a_side: int) -> NDArray[np.int64]:
    """Return the pixel of each part of the picture that meets most; of several, the most central.

    Args:
        coverage_RR: share of each pixel's rays that meet something.
        anchors_a_side: parts along a side, a divisor of R.

    Returns:
        [A] pixels, counted row by row; parts row by row.
    """
    width = len(coverage_RR)
    step = width // anchors_a_side
    offset = np.arange(step) - (step - 1) / 2
    # the center of an even part lies between pixels: the tie is broken, the same way everywhere
    central = np.hypot(offset[:, None] - 0.1, offset[None] - 0.05)
    prefers = (central.max() - central) / (1000 * max(central.max(), 1))
    parts = coverage_RR.reshape(anchors_a_side, step, anchors_a_side, step).swapaxes(1, 2)
    best = (parts + prefers).reshape(anchors_a_side, anchors_a_side, -1).argmax(axis=-1)
    first = np.arange(anchors_a_side) * step
    pixels: NDArray[np.int64] = (first[:, None] + best // step) * width + first + best % step
    return pixels.ravel()


def gathered_at(
    scene: LitScene,
    light: SceneLight,
    hits: CameraHits,
    anchor: NDArray[np.int64],
    gather_rays: int,
    seed: int,
) -> Floats:
    """Return irradiance over pi from other surfaces [A, 3] at the first thing in anchors' pixels.

    Args:
        anchor: [A] pixels.
        gather_rays: of each anchor; 0 gives 0.
    """
    total = np.zeros_like(hits.along, shape=(3, len(anchor)))
    if not gather_rays:
        return total.T
    shift = scene.here(rng_for(seed, "gather").random((5, len(anchor)), np.float32))
    count = len(hits.triangle)
    is_hit = hits.triangle[:, anchor] >= 0
    first = count - (is_hit * np.arange(count, 0, -1)[:, None]).max(axis=0)
    ray = np.minimum(first, count - 1), anchor
    triangle = hits.triangle[ray]
    uv = hits.uv[:, ray[0], anchor].copy()
    direction = hits.along[ray[0], :, anchor].T.copy()
    # on the CPU ray by ray: numpy's sums depend on the length of the rows that are summed
    groups = [first < count] if scene.place else [first == ray_index for ray_index in range(count)]
    for in_group in groups:
        rows = np.flatnonzero(in_group)
        if len(rows):
            points = scene.points(np.maximum(triangle[rows], 0), uv[:, rows], direction[:, rows])
            total[:, rows] = _gather_light(scene, light, points, shift[:, rows], gather_rays)
    return total.T.copy()


def _gather_light(
    scene: LitScene, light: SceneLight, points: Points, shift: Floats, gather_rays: int
) -> Floats:
    """Return the means [3, P] over rays; `shift` [5, P] are uniform numbers."""
    count = shift.shape[1]
    owner = np.tile(np.arange(count), gather_rays)
    u = np.concatenate(
        [
            np.stack([spread(shift[pair], index) for index in range(gather_rays)], axis=1)
            for pair in (slice(0, 2), slice(2, 4))
        ]
    ).reshape(4, -1)
    u_lamp = np.tile(shift[4], gather_rays) + np.repeat(_van_der_corput(gather_rays), count)
    u_lamp -= np.floor(u_lamp)
    total = np.zeros_like(u, shape=(3, count * gather_rays))
    for part in blocks(scene, count * gather_rays):
        anchor_points = points.only(owner[part])
        direction = cosine_direction(u[:2, part], anchor_points.normal, anchor_points.edge)
        beyond, is_hit = scene.meet(scene.everything, anchor_points.start(direction), direction)
        spreads = np.zeros_like(is_hit)
        radiance = outgoing_radiance(scene, light, beyond, u_lamp[part], u[2:, part], spreads)
        total[:, part] = np.where(is_hit, radiance, np.float32(0))
    return total.reshape(3, gather_rays, count).mean(axis=1)


def _van_der_corput(count: int) -> Floats:
    """Return the first `count` numbers of the sequence of base 2 (van der Corput 1935)."""
    number = np.arange(count)
    total = np.zeros(count)
    share = 0.5
    while number.any():
        total += share * (number & 1)
        number, share = number >> 1, share / 2
    return total.astype(np.float32)
