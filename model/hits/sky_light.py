"""Direct light from the sky at points: rays drawn by its map and by the surface (MIS).

A smooth sky is found by directions that lie around the normal, a sun by those that its map draws,
and what a glossy surface mirrors by rays that its lobe draws. Each direction counts by the density
of all of them together (the balance heuristic, Veach and Guibas 1995). Unbiased.
"""

import numpy as np
from numpy.typing import NDArray

from model.hits.direct_light import DirectLight
from model.hits.lit_scene import LitScene, Points, off_surface
from model.hits.reflectance import Gloss, lobe
from model.hits.vectors import Floats, as_rows, cosine_direction, dot, spread

_INV_PI = np.float32(1 / np.pi)

_FAR_M = np.float32(1e30)
"""Beyond all surfaces."""

_LEAST = np.float32(1e-20)


def add_sky_light(
    light: DirectLight,
    scene: LitScene,
    points: Points,
    gloss: Gloss | None,
    shift: Floats,
    ray_index: NDArray[np.intp] | int,
    *,
    rays: int,
    lobe_rays: int,
) -> None:
    """Add the light of a scene's sky to that of its lamps.

    Args:
        light: what is added to.
        scene: has a sky.
        points, gloss, lobe_rays: as in `direct_light`.
        shift: [2, P] uniform numbers.
        ray_index: which of the rays of its pixel a point is ([P]), whose directions all differ.
        rays: towards the sky from each point, half of them, or one more, by the map.
    """
    for number in range(rays):
        u = spread(shift, ray_index * rays + number)
        if number < _by_map(rays):
            direction = scene.drawn_sky.sample_directions(u)
        else:
            direction = cosine_direction(u, points.normal, points.edge)
        cosine = np.maximum(dot(points.normal, direction), 0)
        density = sky_density(scene, direction, cosine, rays)
        diffuse = cosine * _INV_PI / density
        specular = None
        if gloss is not None:
            value, of_lobe = lobe(gloss, points, direction, dot(points.normal, direction))
            specular = value / (density + lobe_rays * of_lobe)
        useful = np.flatnonzero(diffuse if specular is None else (diffuse > 0) | (specular > 0))
        if not len(useful):
            continue
        is_free = sees_sky(scene, points.only(useful), direction[:, useful])
        radiance = scene.drawn_sky.radiance(direction[:, useful])
        arrives = radiance * diffuse[useful]
        light.open_diffuse[:, useful] += arrives
        light.diffuse[:, useful] += arrives * is_free
        if specular is not None and gloss is not None:
            colored = gloss.color[:, useful] * specular[useful] * radiance
            light.open_specular[:, useful] += colored
            light.specular[:, useful] += colored * is_free


def _by_map(rays: int) -> int:
    """Return how many of the rays towards the sky the map draws."""
    return (rays + 1) // 2


def sky_density(scene: LitScene, direction: Floats, cosine: Floats, rays: int) -> Floats:
    """Return the number of rays [P] that `add_sky_light` sends along directions, per steradian."""
    density: Floats = _by_map(rays) * scene.drawn_sky.pdf(direction)
    density += (rays - _by_map(rays)) * _INV_PI * np.maximum(cosine, 0)
    return np.maximum(density, _LEAST)


def escaped_light(
    scene: LitScene, points: Points, gloss: Gloss, direction: Floats, weight: Floats, rays: int
) -> Floats:
    """Return the sky's light along directions [3, P] that the lobe has drawn, without shadows.

    It is weighed for use with `add_sky_light` of so many rays and one by the lobe.

    Args:
        scene: has a sky.
        points, gloss: where the rays begin.
        direction, weight: of `reflectance.sample_lobe`.
        rays: as in `add_sky_light`.
    """
    cosine = dot(points.normal, direction)
    _, of_lobe = lobe(gloss, points, direction, cosine)
    sky_rays = sky_density(scene, direction, cosine, rays)
    share = of_lobe / (of_lobe + sky_rays)
    escaped: Floats = gloss.color * (weight * share) * scene.drawn_sky.radiance(direction)
    return escaped


def sees_sky(scene: LitScene, points: Points, direction: Floats) -> NDArray[np.bool_]:
    """Return True [P] for rays from points that meet nothing, lamps included."""
    start = off_surface(points.position, points.geometric_normal, direction)
    far = np.full_like(direction[0], _FAR_M)
    return scene.everything.is_free(as_rows(start), as_rows(direction), far)
