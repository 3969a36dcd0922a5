"""The path tracer inside a kernel: emitter and BRDF sampling by multiple importance sampling (MIS).

Per path it does what Mitsuba's `path` integrator does with `hide_emitters` (same depth count, same
roulette), for the one kind of surface and the one kind of emitter that a `Scene` has. An emitter
reflects as any surface does, by its material row, and what is black ends the path. Leaving out
virtual calls makes it 1.8 times as fast (study S1), and one kernel serves every scene, view and
number of emitters.

Both are weighed against light tracing too (pipeline.renders.light_kernel has the formulas), unless
there are no light paths. Where the scene has a guide, half of the directions of rough surfaces come
from its table (pipeline.renders.guide_table), which makes another kernel. So does an environment
map (pipeline.renders.sky_table): picks go to it in a stated share, and what meets nothing finds it.
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders import ggx
from pipeline.renders.film import Film
from pipeline.renders.guide_table import Guidance
from pipeline.renders.kernel_scene import (
    MAX_MIS_RATIO,
    SMALLEST_COSINE,
    KernelParts,
    KernelScene,
    Vertex,
    face_viewer,
    hit_of,
    next_hit,
    off_surface,
    roulette,
    vertex_at,
)
from pipeline.renders.surface_table import Hit, SurfacePoint


@dr.syntax
def trace(
    scene: KernelScene, film: Film, parts: KernelParts, light_paths: Any, sampler: Any, ray: Any
) -> list[Any]:
    """Return the radiance (Color3f) of each part along camera rays; emitters are not seen.

    Args:
        film: the camera.
        parts: the sums that are kept apart.
        light_paths: Float, light paths for each sample of a pixel. What they may find is left out
            in proportion.
        sampler: mi.Sampler with a lane for each ray.
        ray: Ray3f from `film`.
    """
    hit, is_met = hit_of(scene.surfaces.ray_intersect_preliminary(ray, coherent=True))
    active = mi.Bool(is_met)
    direction = mi.Vector3f(ray.d)
    radiance = _background(scene, parts, direction, active)
    throughput = mi.Color3f(1)
    share = parts.first_share()
    pdf = mi.Float(0)
    depth = mi.UInt32(0)
    guided = mi.Float(1)
    # the ratio L / P * product of C+_i r_i / (c_i C-_(i+1)) of pipeline.renders.light_kernel
    mis_ratio = light_paths * dr.square(hit.distance) / film.pdf(direction)
    while active:
        point = scene.table.point(hit, active)
        mis_ratio /= dr.maximum(dr.abs(dr.dot(point.geometric_normal, direction)), SMALLEST_COSINE)
        emits = active & (hit.triangle >= scene.num_surfaces)
        landing = dr.select(depth > 1, mis_ratio, 0)
        seen = _seen_emission(scene, point, hit, direction, pdf, landing, emits)
        radiance = parts.add(radiance, throughput * seen, depth, share)
        depth += 1
        active &= depth < scene.max_depth
        vertex, _ = face_viewer(scene, vertex_at(scene, point, hit, direction, active), active)
        guidance = _guidance(scene, vertex, active & (depth > 1))
        u = sampler.next_2d(active)
        lit, local = _direct_light(scene, vertex, guidance, mis_ratio, depth, u, active)
        lit_share = parts.carry_share(vertex, local, depth, share)
        radiance = parts.add(radiance, throughput * lit, depth, lit_share)
        u_lobe = sampler.next_1d(active)
        u_local = sampler.next_2d(active)
        local = _sample_direction(vertex, guidance, u_lobe, u_local, active)
        reflected, unguided = vertex.evaluate(local)
        pdf = _density(vertex, guidance, unguided, local, active)
        share = parts.carry_share(vertex, local, depth, share)
        active &= pdf > 0
        guided *= _ratio(guidance, pdf, unguided)
        throughput = dr.select(active, throughput * reflected / pdf, throughput)
        mis_ratio = dr.minimum(
            mis_ratio * _reverse_pdf_term(vertex, local, depth) / pdf, MAX_MIS_RATIO
        )
        u_end = sampler.next_1d(active)
        throughput, active = roulette(scene, throughput, depth, u_end, active, guided)
        direction = mi.Vector3f(vertex.frame.to_world(local))
        hit, is_met = next_hit(scene, point, direction, active)
        lit = _sky_emission(scene, direction, pdf, throughput, active & ~is_met)
        radiance = radiance if lit is None else parts.add(radiance, lit, depth, share)
        active &= is_met
    return radiance


def _seen_emission(
    scene: KernelScene,
    point: SurfacePoint,
    hit: Hit,
    direction: Any,
    pdf: Any,
    landing: Any,
    emits: Any,
) -> Any:
    """Return the emission that a sampled direction hit, weighed against the other strategies."""
    row = dr.select(emits, hit.triangle - scene.num_surfaces, 0)
    area_pdf, emitted = scene.emitters.pdf_and_radiance(row, emits)
    cosine = dr.abs(dr.dot(point.geometric_normal, direction))
    emitter_density = scene.to_pick_pdf(area_pdf) * dr.square(hit.distance) / cosine
    leaving = scene.cone.pdf(point.position, point.geometric_normal, -direction)
    other_ratios_sq = dr.square(emitter_density / pdf) + dr.square(landing * area_pdf * leaving)
    shines = emits & (dr.max(emitted) > 0)  # one that is off has no density: 0/0 at grazing angles
    return dr.select(shines, emitted / (1 + other_ratios_sq), 0)


def _background(scene: KernelScene, parts: KernelParts, direction: Any, is_hit: Any) -> list[Any]:
    """Return the sums with the sky behind camera rays that hit nothing; it is direct light."""
    if scene.sky is None or not scene.sky.is_seen:
        return parts.dark()
    seen, _ = scene.sky.radiance_and_density(direction, ~is_hit)
    return parts.add(parts.dark(), dr.select(is_hit, 0, seen), mi.UInt32(1), parts.first_share())


def _sky_emission(scene: KernelScene, direction: Any, pdf: Any, throughput: Any, free: Any) -> Any:
    """Return the sky's light where a sampled direction hits nothing; None without a sky."""
    if scene.sky is None:
        return None
    radiance, picks = scene.sky.radiance_and_density(direction, free)
    return throughput * dr.select(free, radiance / (1 + dr.square(picks / pdf)), 0)


def _guidance(scene: KernelScene, vertex: Vertex, active: Any) -> Guidance | None:
    if scene.guide is None:
        return None
    return scene.guide.at(vertex.hit, vertex.front, vertex.lobes, active)


def _sample_direction(
    vertex: Vertex, guidance: Guidance | None, u_lobe: Any, u_local: Any, active: Any
) -> Any:
    """Return the next direction (Vector3f, in the frame) of a path."""
    if guidance is None:
        return ggx.sample(vertex.lobes, vertex.incoming, u_lobe, u_local)
    guided = u_lobe < guidance.share
    world = guidance.sample(u_local, active & guided)
    u_rest = (u_lobe - guidance.share) / (1 - guidance.share)
    local = ggx.sample(vertex.lobes, vertex.incoming, u_rest, u_local)
    return mi.Vector3f(dr.select(guided, vertex.frame.to_local(world), local))


def _density(
    vertex: Vertex, guidance: Guidance | None, unguided: Any, local: Any, active: Any
) -> Any:
    """Return the density of `_sample_direction` from that of a BRDF sample."""
    if guidance is None:
        return unguided
    return guidance.mixture(unguided, vertex.frame.to_world(local), active)


def _ratio(guidance: Guidance | None, pdf: Any, unguided: Any) -> Any:
    """Return the density of a guided direction over its BRDF density; 1 where that is 0."""
    return 1 if guidance is None else dr.select(unguided > 0, pdf / unguided, 1)


def _reverse_pdf_term(vertex: Vertex, local: Any, depth: Any) -> Any:
    """Return C+ r of a light path that comes from `local`; r is 1 at x1, where it ends."""
    drawn = dr.select(depth > 1, vertex.reverse_pdf(local), 1)
    return dr.abs(dr.dot(vertex.geometric, local)) * drawn


def _direct_light(
    scene: KernelScene,
    vertex: Vertex,
    guidance: Guidance | None,
    mis_ratio: Any,
    depth: Any,
    u: Any,
    active: Any,
) -> tuple[Any, Any]:
    """Return the light of one pick, a point of a lamp or a direction of the sky, and its direction.

    The direction is in the frame. The light is weighed against the other strategies.
    """
    pick = picked_light(scene, vertex.point.position, u, active)
    local = vertex.frame.to_local(pick.direction)
    reflected, unguided = vertex.evaluate(local)
    pdf = _density(vertex, guidance, unguided, local, active)
    landing = mis_ratio * _reverse_pdf_term(vertex, local, depth) * pick.leaving / pick.distance_sq
    other_ratios_sq = dr.square(pdf / pick.pdf) + dr.square(dr.select(depth > 1, landing, 0))
    useful = active & (dr.max(reflected) > 0) & dr.isfinite(pick.pdf)
    shadow_ray = pick.shadow_ray(off_surface(vertex.point, pick.direction))
    lit = useful & ~scene.everything.ray_test(shadow_ray, active=useful)
    weighed = reflected * pick.radiance / (pick.pdf * (1 + other_ratios_sq))
    return dr.select(lit, weighed, 0), local


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
    direction, pdf, radiance = scene.sky.sample(u_sky, active & is_sky)
    # A light path leaves a lamp with its density among lamps; picks have only their share of it.
    leaving = lamp.leaving / dr.maximum(scene.to_pick_pdf(mi.Float(1)), _LEAST_SHARE)
    return replace(
        lamp,
        direction=mi.Vector3f(dr.select(is_sky, direction, lamp.direction)),
        pdf=dr.select(is_sky, pdf, scene.to_pick_pdf(lamp.pdf)),
        radiance=mi.Color3f(dr.select(is_sky, radiance, lamp.radiance)),
        leaving=dr.select(is_sky, 0, leaving),
        distance_sq=dr.select(is_sky, 1, lamp.distance_sq),
        is_sky=is_sky,
    )


def _of_lamps(scene: KernelScene, position: Any, u: Any, active: Any) -> PickedLight:
    emitter = scene.emitters.sample(u, active)
    to_emitter = emitter.position - position
    distance_sq = dr.squared_norm(to_emitter)
    direction = to_emitter * dr.rsqrt(distance_sq)
    cosine = dr.abs(dr.dot(emitter.geometric_normal, direction))
    return PickedLight(
        direction=direction,
        pdf=emitter.area_pdf * distance_sq / cosine,
        radiance=emitter.radiance,
        leaving=scene.cone.pdf(emitter.position, emitter.geometric_normal, -direction),
        distance_sq=distance_sq,
        position=emitter.position,
    )
