"""Radiance from the surfaces that rays meet: direct light there, and radiosity for the rest.

So light of any number of diffuse bounces arrives by one ray. A ray that meets a mirror goes on.
Lamps are small: of rays that spread, one in thousands is mirrored onto one, and is then a thousand
times too bright. So lamps are sampled at every surface, whose lobe counts as wider than it is
(Kaplanyan and Dachsbacher 2013): reflected light of lamps is blurred, and does not flicker. Rays
that hardly spread, since a mirror sent them, show lamps in the next mirror as sharply as it does.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from model.hits.direct_light import chosen_lamp_light, lamp_chances, lobe_ray_weight
from model.hits.lit_scene import LitScene, Points
from model.hits.radiosity import SceneLight
from model.hits.reflectance import gloss_at, lobe, sample_lobe
from model.hits.vectors import Floats, brightest, dot

WIDENED_ALPHA = np.float32(0.4)
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


def outgoing_radiance(
    scene: LitScene,
    light: SceneLight,
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
    sent: Floats = spread_out * light.but_lamps_2T3[sides, points.triangle].T
    has_lobe_ray = is_sharp & is_mirror
    keeps_width = has_lobe_ray | (is_sharp & (alpha >= SMOOTH_ALPHA))
    gloss = gloss_at(scene, points, np.where(keeps_width, np.float32(0), WIDENED_ALPHA))
    chances = lamp_chances(scene, points, gloss)
    if len(scene.lamps):
        sent += chosen_lamp_light(scene, points, gloss, chances, u_lamp, on_lamp, has_lobe_ray)
    rows = np.flatnonzero(is_mirror)
    if mirrors and len(rows):
        sent[:, rows] += _mirrored_radiance(
            scene, light, points, rows, chances, (u_lamp, on_lamp), is_sharp[rows], mirrors
        )
    return sent


def _mirrored_radiance(
    scene: LitScene,
    light: SceneLight,
    points: Points,
    rows: NDArray[np.intp],
    chances: Floats,
    u: tuple[Floats, Floats],
    is_sharp: NDArray[np.bool_],
    mirrors: int,
) -> Floats:
    """Return the radiance [3, rows] that some points, which are mirrors, reflect."""
    u_lamp = u[0][rows]
    on_lamp = u[1][:, rows]
    mirror_points = points.only(rows)
    gloss = gloss_at(scene, mirror_points)
    onward, weight = sample_lobe(gloss, mirror_points, on_lamp)
    beyond, is_hit = scene.meet(scene.everything, mirror_points.start(onward), onward)
    seen = outgoing_radiance(
        scene, light, beyond, u_lamp, on_lamp[::-1], is_sharp, mirrors=mirrors - 1
    )
    lit = np.flatnonzero(is_sharp & is_hit & scene.emits[beyond.triangle])
    if len(lit):
        some = mirror_points.only(lit)
        lamp_points = beyond.only(lit)
        along = onward[:, lit]
        _, density = lobe(gloss.only(lit), some, along, dot(some.normal, along))
        number = np.searchsorted(scene.lamps, lamp_points.triangle).clip(0, len(scene.lamps) - 1)
        chance = chances[number, rows[lit]]
        mis_weight = lobe_ray_weight(scene, lamp_points, some.position, density, chance)
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
    step = BLOCK if scene.place is None else DEVICE_BLOCK
    for first in range(0, count, step):
        yield slice(first, min(first + step, count))
