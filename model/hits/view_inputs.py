"""Inputs of a view: results of the rays of each pixel and of anchors, as numbers for a network.

A pixel has rays_a_side^2 rays, whose findings are averaged after shading, as the film does. Light
from other surfaces is smooth but where it is mirrored. So it is gathered by many rays at few
anchors, a grid over the picture. Mirrors reflect every ray of a pixel, since what they show has
edges too; of a rougher surface one ray stands for all, unless nothing denoises the picture.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from model.hits.anchors import (
    DIMMEST,
    SMOOTH_ALPHA,
    CameraHits,
    Rays,
    anchor_pixels,
    blocks,
    camera_hits,
    gathered_at,
    outgoing_radiance,
)
from model.hits.device_arrays import DeviceArray, aside
from model.hits.direct_light import (
    DirectLight,
    direct_light,
    escaped_light,
    lobe_ray_weight,
    sky_light,
)
from model.hits.lit_scene import Gloss, LitScene, PerPoint, Points, gloss_at, sample_lobe
from model.hits.vectors import Floats, at_rows, brightest, dot, spread
from storage.seeds import rng_for

if TYPE_CHECKING:  # it loads pydantic
    from model.config import ModelConfig


class Channel:
    """Position of each quantity in the last axis of the pixels of `view_inputs`."""

    COVERAGE = slice(0, 1)
    """Share of the pixel's rays that meet something."""
    POSITION = slice(1, 4)
    """Mean point of those, meters, world space."""
    DISTANCE = slice(4, 5)
    """Mean distance from the camera."""
    NORMAL = slice(5, 8)
    """Mean shading normal, towards the camera's side."""
    TOWARD = slice(8, 11)
    """Mean unit vector to the camera."""
    DIFFUSE = slice(11, 14)
    """Mean diffuse albedo."""
    SPECULAR = slice(14, 17)
    """Mean specular albedo, with what multiple scattering adds."""
    ROUGHNESS = slice(17, 18)
    """Mean roughness."""
    OPEN_DIFFUSE = slice(18, 21)
    """Irradiance over pi from lamps and the sky as if nothing stood between."""
    DIRECT_DIFFUSE = slice(21, 24)
    """Irradiance over pi from them, shadowed."""
    OPEN_SPECULAR = slice(24, 27)
    """Specular radiance from them as if nothing stood between; over all rays of the pixel."""
    DIRECT_SPECULAR = slice(27, 30)
    """Specular radiance from them, shadowed; over all rays of the pixel."""
    SHOWN_DIFFUSE = slice(30, 33)
    """Diffuse radiance from them, shadowed: albedo times irradiance, over all rays."""
    MIRRORED = slice(33, 36)
    """Specular radiance from other surfaces, by mirrored rays; over all rays of the pixel."""
    SEEN_ALBEDO = slice(36, 39)
    """Diffuse and specular albedo of what those rays met; 0 where they met nothing."""
    SEEN_NEARNESS = slice(39, 40)
    """1 / (1 + d) for a way of d meters to it; 0 where they met nothing."""


NUM_CHANNELS = 40


def view_inputs(
    scene: LitScene,
    c2w: Floats,
    fov_deg: Any,
    resolution: int,
    config: "ModelConfig",
    seed: int = 0,
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """Trace the inputs of a view; equal arguments give equal numbers.

    Args:
        c2w: [4, 4] of the camera.
        fov_deg: its full field of view.
        resolution: pixels across.
        config: numbers of rays and anchors, of which as many a side are taken as divide the
            resolution. Without gather_rays nothing is gathered, and nothing mirrored. Each ray of
            a pixel is shaded where nothing denoises pictures of this width.
        seed: of the noise, which stays where it is on the picture from view to view.

    Returns:
        Numbers of the pixels [R, R, 40], by `Channel`, 0 where nothing is met; the pixel [A] that
        each anchor stands in, counted row by row: the fullest of its part; and irradiance over pi
        from other surfaces at the anchors [A, 3], 0 where nothing is met.
    """
    rays = Rays(c2w, fov_deg, resolution, config.hit_rays)
    hits = camera_hits(scene, rays)
    coverage_RR = hits.coverage.reshape(resolution, resolution)
    anchor = anchor_pixels(coverage_RR, math.gcd(config.hit_anchors, resolution))
    with aside(scene.device) as join_gathered:
        gathered = gathered_at(scene, hits, anchor, config.gather_rays, seed)
    rng = rng_for(seed, "hits", resolution)
    noise = _Noise(
        on_lamps=scene.here(rng.random((2, len(scene.lamps), resolution**2), np.float32)),
        chance=scene.here(rng.random((6, resolution**2), np.float32)),
        to_sky=None  # a generator of its own: scenes without a sky keep their noise
        if scene.sky is None
        else scene.here(
            rng_for(seed, "hits of a sky", resolution).random((2, resolution**2), np.float32)
        ),
    )
    sums = np.zeros_like(noise.chance, shape=(NUM_CHANNELS, resolution**2))
    for part in blocks(scene, resolution**2):
        of_part = hits.only(part), noise.only(part)
        _add_pixels(sums[:, part], scene, rays, *of_part, config)
    join_gathered()
    pixels = _average_rays(sums, rays.rays_per_pixel).T.copy()
    return pixels.reshape(resolution, resolution, NUM_CHANNELS), anchor, gathered


@dataclass(frozen=True, kw_only=True, eq=False)
class _Noise(PerPoint):
    """Uniform numbers of P pixels."""

    on_lamps: Floats
    """[2, lamps, P] where on each lamp."""
    chance: Floats
    """[6, P] for the rays that lobes draw, and for the one ray of each pixel."""
    to_sky: Floats | None
    """[2, P] for rays to the sky; None without a sky."""


def _add_pixels(
    sums: Floats,
    scene: LitScene,
    rays: Rays,
    hits: CameraHits,
    noise: _Noise,
    config: "ModelConfig",
) -> None:
    """Add what rays find of a block of pixels to its sums [40, P]; on a GPU, in two branches."""
    has_lobe_rays = config.gather_rays > 0
    shades_each = not config.denoises(rays.resolution)
    block, by_lobe, shading = _shading_points(
        scene, hits, noise.chance[5], sums, has_lobe_rays, shades_each
    )
    if not len(block.pixel):
        return
    with aside(scene.device) as join_direct:
        _add_surface(block, scene, rays.origin)
        lobe_rays = int(has_lobe_rays)
        at = block.points, block.gloss
        ray = block.pixel, block.ray_index
        lit = direct_light(scene, *at, noise.on_lamps, *ray, lobe_rays=lobe_rays)
        _add_light(block, scene, lit)
        if noise.to_sky is not None:
            sky_rays = config.sky_rays
            lit = sky_light(scene, *at, noise.to_sky, *ray, rays=sky_rays, lobe_rays=lobe_rays)
            _add_light(block, scene, lit)
    if has_lobe_rays:
        u = at_rows(noise.chance[:5], by_lobe.pixel)
        u[:2] = spread(u[:2], by_lobe.ray_index)
        u[3:] = spread(u[3:], by_lobe.ray_index)
        _add_lobe_rays(by_lobe, scene, u, shading, config.sky_rays)
    join_direct()
    if by_lobe.sums is not sums:
        sums[:] += by_lobe.sums


@dataclass(frozen=True, kw_only=True, eq=False)
class _Block(PerPoint):
    """Points that are shaded together, and where their light is added up."""

    points: Points
    gloss: Gloss
    sums: Floats
    """[40, pixels of the block]"""
    pixel: NDArray[np.intp]
    """[P] number of each point's pixel in the block."""
    ray_index: NDArray[np.intp]
    """[P] number of its ray among those of the pixel."""
    weight: NDArray[np.float32]
    """[P] number of the pixel's rays that it stands for."""

    def add(
        self, channel: slice, values: NDArray[np.float32], rows: NDArray[np.intp] | None = None
    ) -> None:
        """Add [channels, P], or of some rows of the points."""
        if isinstance(self.sums, DeviceArray):
            self._add_all(channel, values, rows)
            return
        pixel = self.pixel if rows is None else self.pixel[rows]
        weighed = values * (self.weight if rows is None else self.weight[rows])
        for number, row in enumerate(range(channel.start, channel.stop)):
            self.sums[row] += np.bincount(pixel, weighed[number], self.sums.shape[1])

    def _add_all(self, channel: slice, values: Any, rows: Any) -> None:
        """Add the values of all rays of the block, ray after ray; where none count, nothing."""
        counts: Any = np.flatnonzero(self.weight)
        rows = counts if rows is None else counts[rows]
        weighed = rows.zero_others(values * self.weight[rows])
        shape = (len(values), -1, self.sums.shape[1])
        self.sums[channel] += weighed.reshape(shape).sum(axis=1)


def _shading_points(
    scene: LitScene,
    hits: CameraHits,
    chance: NDArray[np.float32],
    sums: Floats,
    has_lobe_rays: bool,
    shades_each: bool,
) -> tuple[_Block, _Block, Floats]:
    """Return the points of a block of pixels that are lit, and those whose lobes send a ray.

    One of a pixel whose rays all meet one triangle without textures stands for all of them, where
    not each ray is shaded; else each ray has its own. Mirrors reflect each ray.

    Returns:
        both, and the rays [P] of the pixel that each lobe's ray counts for as to surfaces.
    """
    triangle = hits.triangle
    rays_per_pixel, count = triangle.shape
    drawn_ray = np.minimum((chance * rays_per_pixel).astype(np.intp), rays_per_pixel - 1)
    alone = np.arange(rays_per_pixel)[:, None] == drawn_ray
    is_one = (triangle == triangle[0]).all(axis=0)
    if scene.textures is not None:
        is_one &= ~scene.textures.is_textured[triangle[0]]
    if shades_each:
        is_one &= False
    sends_one = is_one
    if has_lobe_rays:
        is_mirror = (scene.means.alpha < SMOOTH_ALPHA) & (brightest(scene.means.specular) > DIMMEST)
        sends_one = is_one & ~is_mirror[triangle[0]]
    stands = (triangle >= 0) & (alone | ~sends_one)
    ray_index, pixel = np.nonzero(stands)
    ray = ray_index * count + pixel
    points = scene.points(
        np.maximum(triangle.reshape(-1)[ray], 0),
        at_rows(hits.uv.reshape(2, -1), ray),
        at_rows(hits.along.swapaxes(0, 1).reshape(3, -1), ray),
    )
    is_there = stands[ray_index, pixel].astype(np.float32)
    chosen = alone[ray_index, pixel] * is_there * np.float32(rays_per_pixel)
    weight = np.where(is_one[pixel], chosen, is_there)
    lit = _Block(
        points=points,
        gloss=gloss_at(scene, points),
        sums=sums,
        pixel=pixel,
        ray_index=ray_index,
        weight=weight,
    )
    by_lobe = replace(lit, weight=np.where(sends_one[pixel], chosen, is_there))
    each_alpha = np.float32(np.inf) if shades_each else SMOOTH_ALPHA
    shading = np.where(by_lobe.gloss.alpha < each_alpha, by_lobe.weight, chosen)
    if scene.place is None:
        return lit.only(np.flatnonzero(weight), but="sums"), by_lobe, shading
    return lit, replace(by_lobe, sums=np.zeros_like(sums)), shading


def _add_surface(block: _Block, scene: LitScene, origin: NDArray[np.float32]) -> None:
    points = block.points
    from_camera = points.position - origin[:, None]
    block.add(Channel.COVERAGE, np.ones_like(points.position[:1]))
    block.add(Channel.POSITION, points.position)
    block.add(Channel.DISTANCE, np.sqrt(dot(from_camera, from_camera))[None])
    block.add(Channel.NORMAL, points.normal)
    block.add(Channel.TOWARD, points.to_viewer)
    block.add(Channel.DIFFUSE, scene.material_at(points, "diffuse"))
    block.add(Channel.SPECULAR, block.gloss.color)
    block.add(Channel.ROUGHNESS, scene.material_at(points, "roughness")[None])


def _add_light(block: _Block, scene: LitScene, lit: DirectLight) -> None:
    block.add(Channel.OPEN_DIFFUSE, lit.open_diffuse)
    block.add(Channel.DIRECT_DIFFUSE, lit.diffuse)
    block.add(Channel.OPEN_SPECULAR, lit.open_specular)
    block.add(Channel.DIRECT_SPECULAR, lit.specular)
    albedo = scene.material_at(block.points, "diffuse")
    block.add(Channel.SHOWN_DIFFUSE, albedo * lit.diffuse)


def _add_lobe_rays(
    block: _Block,
    scene: LitScene,
    u: NDArray[np.float32],
    shading: NDArray[np.float32],
    sky_rays: int,
) -> None:
    """Add what rays drawn by the lobe meet: lamps, weighed by multiple importance, and surfaces.

    Those that meet nothing bring their share of the sky.

    Args:
        u: [5, P] uniform numbers.
        shading: [P] rays of the pixel that a ray counts for as to surfaces; 0: it counts for none.
    """
    some = np.flatnonzero(brightest(block.gloss.color) > DIMMEST)
    direction, weight = sample_lobe(
        block.gloss.only(some), block.points.only(some), at_rows(u[:2], some)
    )
    goes = np.flatnonzero(weight > 0)
    some = some[goes]
    direction = at_rows(direction, goes)
    weight = weight[goes]
    if not len(some):
        return
    points = block.points.only(some)
    gloss = block.gloss.only(some)
    beyond, is_hit = scene.meet(points.start(direction), direction)
    arrives = gloss.color * np.where(is_hit, weight, np.float32(0))
    lamps = np.flatnonzero(is_hit & scene.emits[beyond.triangle])
    if len(lamps):
        lamp_points = beyond.only(lamps)
        rays = gloss.only(lamps), points.only(lamps), at_rows(direction, lamps)
        mis_weight = lobe_ray_weight(scene, *rays, lamp_points)
        emission = np.take(scene.emission, lamp_points.triangle, axis=1)
        emitted = at_rows(arrives, lamps) * emission * mis_weight
        block.add(Channel.DIRECT_SPECULAR, emitted, some[lamps])
        block.add(Channel.OPEN_SPECULAR, emitted, some[lamps])
    if scene.sky is not None:
        escaped = escaped_light(scene, points, gloss, direction, weight, sky_rays)
        block.add(Channel.OPEN_SPECULAR, escaped, some)
        block.add(Channel.DIRECT_SPECULAR, np.where(is_hit, np.float32(0), escaped), some)
    shaded = np.flatnonzero(is_hit & (shading[some] > 0))
    if len(shaded):
        rows = some[shaded]
        is_sharp = gloss.alpha[shaded] < SMOOTH_ALPHA
        seen = beyond.only(shaded)
        radiance = outgoing_radiance(scene, seen, u[2, rows], u[3:5, rows], is_sharp)
        # `add` multiplies by the rays whose lamps a point stands for
        counts = shading[rows] / np.maximum(block.weight[rows], np.float32(1))
        block.add(Channel.MIRRORED, radiance * at_rows(arrives, shaded) * counts, rows)
        path = seen.position - at_rows(points.position, shaded)
        albedo = scene.material_at(seen, "diffuse") + scene.material_at(seen, "specular")
        block.add(Channel.SEEN_ALBEDO, albedo * counts, rows)
        block.add(Channel.SEEN_NEARNESS, (counts / (1 + np.sqrt(dot(path, path))))[None], rows)


def _average_rays(sums: NDArray[np.float32], rays_per_pixel: int) -> NDArray[np.float32]:
    """Return means: of surfaces over the rays that met one, of radiance over all."""
    covered = np.maximum(sums[Channel.COVERAGE], np.float32(1))
    means = sums / np.float32(rays_per_pixel)
    of_surfaces = slice(Channel.POSITION.start, Channel.OPEN_SPECULAR.start)
    means[of_surfaces] = sums[of_surfaces] / covered
    return means
