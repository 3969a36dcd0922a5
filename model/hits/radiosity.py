"""Radiosity: direct light of triangles, and diffuse bounces between all of them.

One number a side of a triangle, which a scene's tokens and gathering rays read.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from model.hits.direct_light import direct_light, sky_light
from model.hits.lit_scene import LitScene, Points
from model.hits.vectors import Floats, cosine_direction, spread
from storage.seeds import rng_for

DIRECT_POINTS = 4
"""Points of a side at which direct light is taken."""

SKY_RAYS = 6
"""Rays towards the sky from each of those points."""

RAYS = 32
"""Rays of a side that say which triangles it faces: 40 ms for 800 triangles."""

BOUNCES = 6
"""Bounces that are added up: at an albedo of 0.6 what is left out is a twentieth."""

_BLOCK = 2**13


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneLight:
    """Light that the two sides of T triangles receive, as irradiance over pi: front, then back."""

    direct_2T3: Floats
    """[2, T, 3] from lamps and the sky."""
    indirect_2T3: Floats
    """[2, T, 3] from other triangles, each as if it were diffuse."""
    mean_3: Floats
    """Mean direct light of the scene's surface, by color: the unit of all light that a network
    reads, so that it cannot tell a bright scene from a dark one. No color counts as darker than a
    thirtieth of the brightest, and it is above 0 without any light."""
    sky_2T3: Floats | None = None
    """[2, T, 3] the part of the direct light that comes from the sky; None where there is none."""

    @cached_property
    def but_lamps_2T3(self) -> Floats:
        """All but the direct light of lamps, [2, T, 3]: what rays take where they have met a side.

        Of the sky that is a mean over the side: its shadows there have no edges.
        """
        if self.sky_2T3 is None:
            return self.indirect_2T3
        return self.indirect_2T3 + self.sky_2T3

    @cached_property
    def sides_T12(self) -> Floats:
        """Direct and indirect light of the front, then of the back, of each triangle."""
        both = (self.direct_2T3, self.indirect_2T3)
        return np.concatenate([part[side] for side in (0, 1) for part in both], axis=-1)


LEAST_SHARE = np.float32(0.03)
"""Least mean light of a color, as a fraction of the brightest color's."""


def scene_light(scene: LitScene) -> SceneLight:
    """Return the light of a scene; equal scenes give equal numbers."""
    rng = rng_for(0, "radiosity")
    direct = _direct(scene, rng)
    sky = None
    if scene.sky is not None:
        sky = _direct(scene, rng_for(0, "radiosity of a sky"), of_sky=True)
        direct = direct + sky
    indirect = _bounce_light(scene, direct, rng)
    weight = scene.area / max(float(2 * scene.area.sum()), 1e-12)
    mean = (direct.sum(axis=0) * weight[:, None]).sum(axis=0)
    return SceneLight(
        direct_2T3=direct,
        indirect_2T3=indirect,
        mean_3=np.maximum(np.maximum(mean, LEAST_SHARE * mean.max()), np.float32(1e-6)),
        sky_2T3=sky,
    )


def _direct(scene: LitScene, rng: np.random.Generator, *, of_sky: bool = False) -> Floats:
    """Return the light of the lamps, or of the sky, [2, T, 3], with its shadows, block by block."""
    rows = np.arange(2 * scene.num_triangles)  # all sides, T front ones first
    total = np.zeros((3, len(rows)), np.float32)
    if of_sky or len(scene.lamps):
        on_triangle = rng.random((2, len(rows)), np.float32)
        lamps = () if of_sky else (len(scene.lamps),)
        towards = rng.random((2, *lamps, len(rows)), np.float32)
        for trial, first in product(range(DIRECT_POINTS), range(0, len(rows), _BLOCK)):
            some = slice(first, first + _BLOCK)
            points = _points(scene, rows[some], spread(on_triangle[:, some], trial))
            drawn = towards, some, trial
            if of_sky:
                light = sky_light(scene, points, None, *drawn, rays=SKY_RAYS, lobe_rays=0)
            else:
                light = direct_light(scene, points, None, *drawn, lobe_rays=0)
            total[:, some] += light.diffuse
    mean = total / np.float32(DIRECT_POINTS)
    return np.ascontiguousarray(mean.T).reshape(2, scene.num_triangles, 3)


def _bounce_light(scene: LitScene, direct_2T3: Floats, rng: np.random.Generator) -> Floats:
    """Return the light that arrives after one or more bounces."""
    rows = np.arange(2 * scene.num_triangles)  # all sides, T front ones first
    on_triangle = rng.random((2, len(rows)), np.float32)
    towards = rng.random((2, len(rows)), np.float32)
    faced = np.zeros((RAYS, len(rows)), np.int64)
    for trial in range(RAYS):
        points = _points(scene, rows, spread(on_triangle, trial))
        direction = cosine_direction(spread(towards, trial), points.normal, points.edge)
        hits, is_hit = scene.meet(points.start(direction), direction)
        side = hits.triangle + scene.num_triangles * hits.back
        faced[trial] = np.where(is_hit, side, len(rows))
    reflects = np.tile((scene.means.diffuse + scene.means.specular).T, (2, 1))
    received = direct_2T3.reshape(-1, 3)
    arrived = np.zeros_like(received)
    for _ in range(BOUNCES):
        sent = np.append((received + arrived) * reflects, np.zeros((1, 3), np.float32), axis=0)
        arrived = sent[faced].mean(axis=0)
    return arrived.reshape(2, -1, 3)


def _points(scene: LitScene, sides: NDArray[np.intp], u: Floats) -> Points:
    """Return a point on each side, evenly spread for u [2, P], seen from straight above."""
    triangle = sides % scene.num_triangles
    down = scene.plane[:, triangle] * np.where(
        sides < scene.num_triangles, np.float32(-1), np.float32(1)
    )
    root = np.sqrt(u[0])
    points = scene.points(triangle, np.stack([root * (1 - u[1]), root * u[1]]), down)
    # the side of the triangle decides, not the shading normal, which may lean over its rim
    back = sides >= scene.num_triangles
    seen = {"normal": -down, "geometric_normal": -down, "to_viewer": -down, "back": back}
    return replace(points, **seen, reflectance=None)
