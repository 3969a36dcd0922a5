"""Direct light at points, with and without its shadow: of lamps, and of the sky.

Of lamps: one point on every lamp's triangle. Unbiased: the mean over points and shifts is the
integral, but for the specular lobe, whose sharp part is left to rays that the lobe draws
(`lobe_ray_weight`).

Of the sky: rays drawn by its map and by the surface (MIS). A smooth sky is found by directions that
lie around the normal, a sun by those that its map draws, and what a glossy surface mirrors by rays
that its lobe draws. Each direction counts by the density of all of them together (the balance
heuristic, Veach and Guibas 1995). Unbiased.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from model.hits.lit_scene import Gloss, LitScene, Points, lobe, off_surface
from model.hits.vectors import Floats, as_rows, at_rows, brightest, cosine_direction, dot, spread

_INV_PI = np.float32(1 / np.pi)

TOGETHER = 2**21
"""Pairs of points and lamps that a GPU computes at a time."""

_SHORTENING = np.float32(1 - 1e-4)
"""Share of the way to a lamp that a shadow ray goes, as the renderer's."""


_EVEN = np.float32(0.05)
"""Reflectance that every lamp counts for, so that none is left out whose middle is not seen."""

_FAR_M = np.float32(1e30)
"""Beyond all surfaces."""

_LEAST = np.float32(1e-20)
"""Least density of rays towards the sky, so that nothing is divided by 0."""


RowsOfPoints = NDArray[np.intp] | slice


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectLight:
    """Light of lamps and the sky at P points, [3, P] each."""

    open_diffuse: Floats
    """Irradiance over pi, without shadows."""
    open_specular: Floats
    """Specular radiance towards the viewer, without shadows."""
    diffuse: Floats
    """Irradiance over pi, with the shadows of all surfaces."""
    specular: Floats
    """Specular radiance towards the viewer, shadowed."""


def _no_light(points: Points) -> DirectLight:
    """Return zeros, to which light is added."""
    return DirectLight(
        **{each.name: np.zeros_like(points.position) for each in fields(DirectLight)}
    )


def direct_light(
    scene: LitScene,
    points: Points,
    gloss: Gloss | None,
    shift: Floats,
    pixel: RowsOfPoints,
    ray_index: NDArray[np.intp] | int,
    *,
    lobe_rays: int,
) -> DirectLight:
    """Return the light of all lamps.

    Args:
        gloss: the lobes there; None where the specular part is not wanted, which is then 0.
        shift: [2, lamps, pixels] uniform numbers.
        pixel: [P] column of `shift` of each point, or their range.
        ray_index: which of the rays of its pixel a point is ([P]), whose places all differ.
        lobe_rays: 1 where a ray is drawn by the lobe at each of these points too: what such rays
            are better at finding is left to them (the power heuristic, Veach and Guibas 1995).
    """
    light = _no_light(points)
    lit_points = points.only(None)  # arrays are [3, l, P] and [l, P]
    gloss = None if gloss is None else gloss.only(None)
    for some in _some_lamps(scene, points):
        lamps = scene.lamps[some]
        u = spread(at_rows(shift[:, some], pixel), ray_index)
        place = _on_triangle(scene, lamps[:, None], u)
        to_lamp = place - lit_points.position
        square = np.maximum(dot(to_lamp, to_lamp), np.float32(1e-12))
        to_lamp = to_lamp / np.sqrt(square)
        cosine = dot(lit_points.normal, to_lamp)
        if scene.place is None:  # one lamp; `dot` rounds otherwise, and pictures keep their bits
            facing = np.abs(scene.plane[:, int(lamps[0])] @ to_lamp[:, 0])[None]
        else:
            facing = np.abs(dot(scene.plane[:, lamps][:, :, None], to_lamp))
        solid = facing * scene.area[lamps][:, None] / square
        diffuse = np.maximum(cosine, 0) * solid * _INV_PI
        specular = None
        if gloss is not None:
            value, density = lobe(gloss, lit_points, to_lamp, cosine)
            specular = value * solid / (1 + np.square(lobe_rays * density * solid))
        useful = diffuse if specular is None else (diffuse > 0) | (specular > 0)
        is_free = _is_free(scene, lit_points, place, to_lamp, useful)
        emission = scene.emission[:, lamps][:, :, None]
        np.add(light.open_diffuse, _total(diffuse * emission), out=light.open_diffuse)
        np.add(light.diffuse, _total(diffuse * is_free * emission), out=light.diffuse)
        if specular is not None and gloss is not None:
            colored = gloss.color * specular * emission
            np.add(light.open_specular, _total(colored), out=light.open_specular)
            np.add(light.specular, _total(colored * is_free), out=light.specular)
    return light


def _some_lamps(scene: LitScene, points: Points) -> Iterator[slice]:
    """Yield which lamps are computed together: one by one, or on a GPU many."""
    count = points.position.shape[1]
    step = 1 if scene.place is None else max(1, TOGETHER // count)
    for first in range(0, len(scene.lamps), step):
        yield slice(first, min(first + step, len(scene.lamps)))


def _total(of_lamps: Floats) -> Floats:
    """Return [3, P] of [3, l, P]."""
    return of_lamps[:, 0] if of_lamps.shape[1] == 1 else of_lamps.sum(axis=1)


def lobe_ray_weight(
    scene: LitScene,
    gloss: Gloss,
    points: Points,
    along: Floats,
    hit_points: Points,
    chance: Floats | float = 1.0,
) -> Floats:
    """Return the share [P] of a lamp's emission that a ray drawn by the lobe has to bring.

    The rest is what `direct_light` brings, or `chosen_lamp_light`.

    Args:
        gloss, points: where the rays began.
        along: [3, P] their directions.
        hit_points: what they hit, lamps or not.
        chance: [P] with which the lamp would have been chosen there; of `direct_light`, 1.
    """
    _, density = lobe(gloss, points, along, dot(points.normal, along))
    to_hit = hit_points.position - points.position
    facing = np.abs(dot(at_rows(scene.plane, hit_points.triangle), hit_points.to_viewer))
    square = np.maximum(dot(to_hit, to_hit), np.float32(1e-12))
    solid = (
        facing * scene.area[hit_points.triangle] / square / np.maximum(chance, np.float32(1e-12))
    )
    mis_ratio = np.square(density * solid)
    weight: Floats = mis_ratio / (1 + mis_ratio)
    return weight


def lamp_chances(scene: LitScene, points: Points, gloss: Gloss) -> Floats:
    """Return the chance [lamps, P] of each lamp's triangle to be chosen at points.

    In proportion to what its middle would send on without shadows, with a share for all: so few
    rays are spent on lamps that are far away or not where a narrow lobe looks.
    """
    shape = len(scene.lamps), points.position.shape[1]
    power_at_points = np.zeros_like(gloss.alpha, shape=shape)
    albedo = scene.means.diffuse.mean(axis=0)[points.triangle] * _INV_PI
    color = gloss.color.mean(axis=0)
    lit_points = points.only(None)
    gloss = gloss.only(None)
    for some in _some_lamps(scene, points):
        lamps = scene.lamps[some]
        middle = scene.corners[:, :, lamps].mean(axis=0)
        to_lamp = middle[:, :, None] - lit_points.position
        square = np.maximum(dot(to_lamp, to_lamp), scene.area[lamps][:, None])
        to_lamp = to_lamp / np.sqrt(square)
        cosine = dot(lit_points.normal, to_lamp)
        value, _ = lobe(gloss, lit_points, to_lamp, cosine)
        sent = albedo * np.maximum(cosine, 0) + color * value + _EVEN
        power = scene.emission[:, lamps].mean(axis=0) * scene.area[lamps]
        power_at_points[some] = sent * power[:, None] / square
    chances: Floats = power_at_points / np.maximum(power_at_points.sum(axis=0), np.float32(1e-30))
    return chances


def chosen_lamp_light(
    scene: LitScene,
    points: Points,
    gloss: Gloss,
    chances: Floats,
    u_lamp: Floats,
    on_lamp: Floats,
    has_lobe_ray: NDArray[np.bool_],
) -> Floats:
    """Return the radiance [3, P] that points send to their viewers of one lamp's light each.

    Unbiased.

    Args:
        scene: with at least one lamp.
        chances: of the lamps there (`lamp_chances`).
        u_lamp: [P] uniform numbers that choose the lamp.
        on_lamp: [2, P] where on it.
        has_lobe_ray: [P] whether a ray drawn by the lobe brings its share of the specular part.
    """
    lamps = scene.lamps
    number = (u_lamp > np.cumsum(chances, axis=0)).sum(axis=0).clip(0, len(lamps) - 1)
    chance = np.maximum(np.take_along_axis(chances, number[None], axis=0)[0], np.float32(1e-12))
    lamp = scene.here(lamps)[number]
    place = _on_triangle(scene, lamp, on_lamp)
    to_lamp = place - points.position
    square = np.maximum(dot(to_lamp, to_lamp), np.float32(1e-12))
    to_lamp = to_lamp / np.sqrt(square)
    cosine = dot(points.normal, to_lamp)
    solid = np.abs(dot(at_rows(scene.plane, lamp), to_lamp)) * scene.area[lamp] / square / chance
    value, density = lobe(gloss, points, to_lamp, cosine)
    value = value / (1 + np.where(has_lobe_ray, np.square(density * solid), np.float32(0)))
    albedo = scene.material_at(points, "diffuse")
    reflected = albedo * (np.maximum(cosine, 0) * _INV_PI) + gloss.color * value
    is_free = _is_free(scene, points, place, to_lamp, brightest(reflected) > 0)
    return np.take(scene.emission, lamp, axis=1) * reflected * (solid * is_free)


def _is_free(
    scene: LitScene, points: Points, place: Floats, to_lamp: Floats, useful: NDArray
) -> Floats:
    """Return 1 for useful points [...] whose segment to their place on a lamp is free, else 0."""
    is_free = np.zeros_like(to_lamp[0]).reshape(-1)
    rows = np.flatnonzero(useful)
    if len(rows):
        position, plane, place, along = (
            at_rows(np.broadcast_to(each, place.shape).reshape(3, -1), rows)
            for each in (points.position, points.geometric_normal, place, to_lamp)
        )
        start = off_surface(position, plane, along)
        segment = place - start
        length = np.sqrt(np.maximum(dot(segment, segment), np.float32(1e-20)))
        ray = as_rows(start), as_rows(segment / length)
        is_free[rows] = scene.everything.is_free(*ray, length * _SHORTENING)
    return is_free.reshape(to_lamp.shape[1:])


def _on_triangle(scene: LitScene, rows: NDArray[np.intp], u: Floats) -> Floats:
    """Return points [3, ...], evenly spread over triangles [...] for u [2, ...] from 0 to 1."""
    root = np.sqrt(u[0])
    corners = at_rows(scene.corners, rows)
    place: Floats = corners[0] * (1 - root)
    place += corners[1] * (root * (1 - u[1]))
    place += corners[2] * (root * u[1])
    return place


def sky_light(
    scene: LitScene,
    points: Points,
    gloss: Gloss | None,
    shift: Floats,
    pixel: RowsOfPoints,
    ray_index: NDArray[np.intp] | int,
    *,
    rays: int,
    lobe_rays: int,
) -> DirectLight:
    """Return the light of a scene's sky.

    Args:
        scene: has a sky.
        points, gloss, pixel, ray_index, lobe_rays: as in `direct_light`.
        shift: [2, pixels] uniform numbers.
        rays: towards the sky from each point, half of them, or one more, by the map.
    """
    light = _no_light(points)
    shift = at_rows(shift, pixel)
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
    return light


def _by_map(rays: int) -> int:
    """Return how many of the rays towards the sky the map draws."""
    return (rays + 1) // 2


def sky_density(scene: LitScene, direction: Floats, cosine: Floats, rays: int) -> Floats:
    """Return the number of rays [P] that `sky_light` sends along directions, per steradian."""
    density: Floats = _by_map(rays) * scene.drawn_sky.pdf(direction)
    density += (rays - _by_map(rays)) * _INV_PI * np.maximum(cosine, 0)
    return np.maximum(density, _LEAST)


def escaped_light(
    scene: LitScene, points: Points, gloss: Gloss, direction: Floats, weight: Floats, rays: int
) -> Floats:
    """Return the sky's light along directions [3, P] that the lobe has drawn, without shadows.

    It is weighed for use with `sky_light` of so many rays and one by the lobe.

    Args:
        scene: has a sky.
        points, gloss: where the rays begin.
        direction, weight: of `sample_lobe`.
        rays: as in `sky_light`.
    """
    cosine = dot(points.normal, direction)
    _, of_lobe = lobe(gloss, points, direction, cosine)
    sky_rays = sky_density(scene, direction, cosine, rays)
    share = of_lobe / (of_lobe + sky_rays)
    escaped: Floats = gloss.color * (weight * share) * scene.drawn_sky.radiance(direction)
    return escaped


def sees_sky(scene: LitScene, points: Points, direction: Floats) -> NDArray[np.bool_]:
    """Return True [P] for rays from points that meet nothing, lamps included."""
    start = points.start(direction)
    far = np.full_like(direction[0], _FAR_M)
    return scene.everything.is_free(as_rows(start), as_rows(direction), far)
