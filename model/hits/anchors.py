"""Camera rays and their first hits, radiance of what rays meet further on, and its anchors.

Radiance from a surface that a ray meets is direct light there, and radiosity for the rest: so light
of any number of diffuse bounces arrives by one ray. A ray that meets a mirror goes on. Lamps are
small: of rays that spread, one in thousands is mirrored onto one, and is then a thousand times too
bright. So lamps are sampled at every surface, whose lobe counts as wider than it is (Kaplanyan and
Dachsbacher 2013): reflected light of lamps is blurred, and does not flicker. Rays that hardly
spread, since a mirror sent them, show lamps in the next mirror as sharply as it does.

Anchors are a few places of a view at which the light of other surfaces is gathered by many rays.
That light is smooth, so its value between anchors may be mixed from theirs (as irradiance caching:
Ward et al. 1988), and costs the same for a picture of any width.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.hits.direct_light import chosen_lamp_light, lamp_chances, lobe_ray_weight
from model.hits.lit_scene import LitScene, PerPoint, Points, gloss_at, sample_lobe
from model.hits.vectors import Floats, at_rows, brightest, cosine_direction, spread, unit
from storage.conventions import focal_px
from storage.seeds import rng_for

WIDENED_ALPHA = np.float32(0.2)
"""GGX width that surfaces have at least, where a ray has met them."""

SMOOTH_ALPHA = np.float32(0.1)
"""GGX width below which a surface shows other surfaces as a mirror; above, as if it were diffuse.
"""

DIMMEST = np.float32(0.02)
"""Specular albedo from which a surface is worth a ray of its own."""

MIRRORS = 2
"""Mirrors after each other through which a ray is followed."""

BLOCK = 2**13
"""Points that are computed at a time: their numbers stay in the CPU's cache."""

DEVICE_BLOCK = 2**18
"""Points that a GPU computes at a time: as many as fit its memory."""

DEVICE_PAIRS = 2**26
"""Pairs of points and lamps in such a block: each array of chances takes 256 MB."""


def outgoing_radiance(
    scene: LitScene,
    points: Points,
    u_lamp: Floats,
    on_lamp: Floats,
    is_sharp: NDArray[np.bool_],
    *,
    mirrors: int = MIRRORS,
) -> Floats:
    """Return the radiance [3, P] that points which rays have met send back along these rays.

    Emission is not counted: what lamps send to where a ray came from is direct light. Light of the
    sky there is that of the whole side of the triangle.

    Args:
        points: where the rays have met it.
        u_lamp, on_lamp: [P] and [2, P] uniform numbers.
        is_sharp: [P] whether only mirrors have sent the rays.
        mirrors: followed at most.
    """
    specular = scene.material_at(points, "specular")
    alpha = scene.material_at(points, "alpha")
    is_mirror = alpha < SMOOTH_ALPHA
    is_mirror &= brightest(specular) > DIMMEST
    is_mirror &= mirrors > 0
    spread_out = scene.material_at(points, "diffuse")
    spread_out = spread_out + np.where(is_mirror, np.float32(0), specular)
    sides = points.back.astype(np.intp)
    sent: Floats = spread_out * scene.light.but_lamps_2T3[sides, points.triangle].T
    has_lobe_ray = is_sharp & is_mirror
    keeps_width = has_lobe_ray | (is_sharp & (alpha >= SMOOTH_ALPHA))
    gloss = gloss_at(scene, points, np.where(keeps_width, np.float32(0), WIDENED_ALPHA))
    chances = lamp_chances(scene, points, gloss)
    if len(scene.lamps):
        sent += chosen_lamp_light(scene, points, gloss, chances, u_lamp, on_lamp, has_lobe_ray)
    rows = np.flatnonzero(is_mirror)
    if mirrors and len(rows):
        sent[:, rows] += _mirrored_radiance(
            scene, points, rows, chances, (u_lamp, on_lamp), is_sharp[rows], mirrors
        )
    return sent


def _mirrored_radiance(
    scene: LitScene,
    points: Points,
    rows: NDArray[np.intp],
    chances: Floats,
    u: tuple[Floats, Floats],
    is_sharp: NDArray[np.bool_],
    mirrors: int,
) -> Floats:
    """Return the radiance [3, rows] that some points, which are mirrors, reflect."""
    u_lamp = u[0][rows]
    on_lamp = at_rows(u[1], rows)
    mirror_points = points.only(rows)
    gloss = gloss_at(scene, mirror_points)
    onward, weight = sample_lobe(gloss, mirror_points, on_lamp)
    beyond, is_hit = scene.meet(mirror_points.start(onward), onward)
    seen = outgoing_radiance(scene, beyond, u_lamp, on_lamp[::-1], is_sharp, mirrors=mirrors - 1)
    lit = np.flatnonzero(is_sharp & is_hit & scene.emits[beyond.triangle])
    if len(lit) and len(scene.lamps):  # on a GPU, `lit` are all rows
        lamp_points = beyond.only(lit)
        number = np.searchsorted(scene.lamps, lamp_points.triangle).clip(0, len(scene.lamps) - 1)
        chance = chances[number, rows[lit]]
        rays = gloss.only(lit), mirror_points.only(lit), at_rows(onward, lit)
        mis_weight = lobe_ray_weight(scene, *rays, lamp_points, chance)
        seen[:, lit] += np.take(scene.emission, lamp_points.triangle, axis=1) * mis_weight
    arrives = np.where(is_hit, weight * seen, np.float32(0))
    if scene.sky is not None:
        # blurred: no other ray shares the sun with this one, which is met once in thousands
        beyond_all = np.flatnonzero(~is_hit & (weight > 0))
        sky = scene.drawn_sky.blurred_radiance(onward[:, beyond_all])
        arrives[:, beyond_all] = weight[beyond_all] * sky
    return gloss.color * arrives


def blocks(scene: LitScene, count: int) -> Iterator[slice]:
    """Yield the parts of `count` points that are computed at a time."""
    step = BLOCK
    if scene.place is not None:
        step = min(DEVICE_BLOCK, DEVICE_PAIRS // max(len(scene.lamps), 1))
    for first in range(0, count, step):
        yield slice(first, min(first + step, count))


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

    def direction(self, ray_index: int) -> Floats:
        """Return unit directions [3, P] of ray `ray_index` of all pixels, counted row by row."""
        row, column = divmod(ray_index, self._a_side)
        count = np.arange(self.resolution, dtype=np.float32) - np.float32(self.resolution / 2)
        x = count + np.float32((column + 0.5) / self._a_side)
        y = -(count + np.float32((row + 0.5) / self._a_side))
        right, up, back = self._axes.T
        along = right[:, None, None] * x + up[:, None, None] * y[:, None]
        along -= (back * self._focal)[:, None, None]
        return unit(along.reshape(3, -1))


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
    scene: LitScene, hits: CameraHits, anchor: NDArray[np.int64], gather_rays: int, seed: int
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
            total[:, rows] = _gather_light(scene, points, shift[:, rows], gather_rays)
    return total.T.copy()


def _gather_light(scene: LitScene, points: Points, shift: Floats, gather_rays: int) -> Floats:
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
        beyond, is_hit = scene.meet(anchor_points.start(direction), direction)
        spreads = np.zeros_like(is_hit)
        radiance = outgoing_radiance(scene, beyond, u_lamp[part], u[2:, part], spreads)
        total[:, part] = np.where(is_hit, radiance, np.float32(0))
    return total.reshape(3, gather_rays, count).mean(axis=1)


def _van_der_corput(count: int) -> Floats:
    """Return the first `count` numbers of the sequence of base 2 (van der Corput 1935)."""
    bits = np.arange(count.bit_length())
    digits = np.arange(count)[:, None] >> bits & 1
    numbers: Floats = (digits * 0.5 ** (bits + 1)).sum(axis=1)
    return numbers.astype(np.float32)
