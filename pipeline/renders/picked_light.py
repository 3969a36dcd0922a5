"""One pick among all that lights a scene: a point of a lamp, or a direction of the sky."""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders.kernel_scene import KernelScene

_SHORTENING = 1e-4
"""Relative length that a shadow ray stops short of its emitter, so that it does not hit it."""

_LEAST_SHARE = 1e-30
"""Smallest fraction of picks that go to lamps, so that nothing divides by 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PickedLight:
    """One sampled point or direction of light, lane by lane."""

    direction: Any
    """Unit direction from the path's vertex, Vector3f."""
    pdf: Any
    """Float, per steradian; not finite where no light can come from there."""
    radiance: Any
    """Radiance of the lamp or the sky, Color3f."""
    leaving: Any
    """Float: density per steradian, of a light path in the unit of picks, to leave towards the
    vertex; 0 of the sky, from which no light paths come."""
    distance_sq: Any
    """Squared distance to the point on the lamp, Float; 1 for the sky."""
    position: Any
    """Point on the lamp, Point3f; means nothing for the sky."""
    is_sky: Any = None
    """Bool; None where there is no sky."""

    def shadow_ray(self, start: Any) -> Any:
        """Return the ray whose hits are the occluders of the light."""
        remaining = self.position - start
        length = dr.norm(remaining)
        ray = mi.Ray3f(start, mi.Vector3f(remaining / length))
        ray.maxt = length * (1 - _SHORTENING)
        if self.is_sky is not None:
            ray.d = dr.select(self.is_sky, self.direction, ray.d)
            ray.maxt = dr.select(self.is_sky, dr.largest(mi.Float), ray.maxt)
        return ray


def picked_light(scene: KernelScene, position: Any, u: Any, active: Any) -> PickedLight:
    """Return a pick for a vertex at a position (Point3f), from a uniform Point2f."""
    if scene.sky is None:
        return _of_lamps(scene, position, u, active)
    is_sky, u_sky, u_lamp = scene.sky.split_picks(u)
    lamp = _of_lamps(scene, position, u_lamp, active & ~is_sky)
    sky = scene.sky.sample(u_sky, active & is_sky)
    # A light path leaves a lamp with its density among lamps; picks have only their share of it.
    leaving = lamp.leaving / dr.maximum(scene.to_pick_pdf(mi.Float(1)), _LEAST_SHARE)
    return replace(
        lamp,
        direction=mi.Vector3f(dr.select(is_sky, sky.direction, lamp.direction)),
        pdf=dr.select(is_sky, sky.pdf, scene.to_pick_pdf(lamp.pdf)),
        radiance=mi.Color3f(dr.select(is_sky, sky.radiance, lamp.radiance)),
        leaving=dr.select(is_sky, 0, leaving),
        distance_sq=dr.select(is_sky, 1, lamp.distance_sq),
        is_sky=is_sky,
    )


def _of_lamps(scene: KernelScene, position: Any, u: Any, active: Any) -> PickedLight:
    emitter = scene.emitters.sample(u, active)
    to_emitter = emitter.position - position
    distance_sq = dr.squared_norm(to_emitter)
    direction = to_emitter * dr.rsqrt(distance_sq)
    cosine = dr.abs(dr.dot(emitter.normal, direction))
    return PickedLight(
        direction=direction,
        pdf=emitter.area_pdf * distance_sq / cosine,
        radiance=emitter.radiance,
        leaving=scene.cone.pdf(emitter.position, emitter.normal, -direction),
        distance_sq=distance_sq,
        position=emitter.position,
    )
