"""What rays bring from the surfaces that they meet: direct light there, and radiosity for the rest.

So light of any number of diffuse bounces arrives by one ray. A ray that meets a mirror goes on.
Lamps are small: a ray that a mirror sends on finds one once in thousands, and is then a thousand
times too bright. So lamps are asked for at every surface, whose lobe counts as wider than it is
(Kaplanyan and Dachsbacher 2013): reflected light of lamps is blurred, and does not flicker.
"""

from collections.abc import Iterator

import numpy as np

from model.hits.direct_light import chosen_lamp_light
from model.hits.lit_scene import LitScene, Points
from model.hits.radiosity import SceneLight
from model.hits.reflectance import gloss_at
from model.hits.vectors import Floats, brightest, dot

WIDENED_ALPHA = 0.25
"""GGX width that surfaces have at least, where a ray has met them."""

SMOOTH_ALPHA = np.float32(0.1)
"""GGX width below which a surface shows other surfaces as a mirror; above, as if it were diffuse.
"""

DIMMEST = np.float32(0.02)
"""Specular albedo from which a surface is worth a ray of its own."""

MIRRORS = 2
"""Mirrors after each other through which a ray is followed."""

BLOCK = 2**13
"""Points that are computed at a time: their numbers stay in the processor's cache."""


def brought(
    scene: LitScene,
    light: SceneLight,
    points: Points,
    u_lamp: Floats,
    on_lamp: Floats,
    *,
    mirrors: int = MIRRORS,
) -> Floats:
    """Return the radiance [3, P] that points which rays have met send back along these rays.

    Emission is not counted: what lamps send to where a ray came from is direct light.

    Args:
        scene, light: the scene.
        points: where the rays have met it.
        u_lamp, on_lamp: [P] and [2, P] uniform numbers.
        mirrors: followed at most.
    """
    specular = np.take(scene.specular, points.triangle, axis=1)
    is_mirror = scene.alpha[points.triangle] < SMOOTH_ALPHA
    is_mirror &= brightest(specular) > DIMMEST
    is_mirror &= mirrors > 0
    spread_out = np.take(scene.diffuse, points.triangle, axis=1)
    spread_out = spread_out + np.where(is_mirror, np.float32(0), specular)
    sides = points.back.astype(np.intp)
    sent: Floats = spread_out * light.indirect_2T3[sides, points.triangle].T
    if len(scene.lamps):
        gloss = gloss_at(scene, points, WIDENED_ALPHA)
        sent += chosen_lamp_light(scene, points, gloss, u_lamp, on_lamp)
    rows = np.flatnonzero(is_mirror)
    if not len(rows):
        return sent
    some = points.only(rows)
    cosine = dot(some.normal, some.toward)
    onward = some.normal * (2 * cosine) - some.toward
    beyond, met = scene.meet(scene.everything, some.start(onward), onward)
    met &= (cosine > 0) & (dot(onward, some.plane) > 0)
    u_beyond = u_lamp[rows], on_lamp[:, rows]
    seen = brought(scene, light, beyond, *u_beyond, mirrors=mirrors - 1)
    sent[:, rows] += specular[:, rows] * np.where(met, seen, np.float32(0))
    return sent


def blocks(count: int) -> Iterator[slice]:
    """Yield the parts of `count` points that are computed at a time."""
    for first in range(0, count, BLOCK):
        yield slice(first, min(first + BLOCK, count))
