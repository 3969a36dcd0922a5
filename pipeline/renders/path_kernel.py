"""The path tracer inside a kernel: emitter sampling and BRDF sampling, weighed against each other.

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

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders import ggx
from pipeline.renders.film import Film
from pipeline.renders.guide_table import Guidance
from pipeline.renders.kernel_parts import KernelParts
from pipeline.renders.kernel_scene import (
    MOST_ODDS,
    SMALLEST_COSINE,
    KernelScene,
    Vertex,
    off_surface,
    roulette,
    vertex_at,
)
from pipeline.renders.picked_light import picked_light
from pipeline.renders.surface_table import SurfacePoint


@dr.syntax
def trace(
    scene: KernelScene, film: Film, parts: KernelParts, light_paths: Any, sampler: Any, ray: Any
) -> list[Any]:
    """Return the radiance (Color3f) of each part along camera rays; emitters are not seen.

    Args:
        scene: the scene.
        film: the camera.
        parts: what is kept apart.
        light_paths: Float, light paths for each sample of a pixel. What they may find is left out
            in proportion.
        sampler: mi.Sampler with a lane for each ray.
        ray: Ray3f from `film`.
    """
    hit = scene.surfaces.ray_intersect_preliminary(ray, coherent=True)
    active, (distance, triangle, barycentric) = mi.Bool(hit.is_valid()), _met(hit)
    origin, direction = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    radiance, throughput = _background(scene, parts, direction, active), mi.Color3f(1)
    share, density, depth, guided = parts.first_share(), mi.Float(0), mi.UInt32(0), mi.Float(1)
    odds = light_paths * dr.square(distance) / film.density(direction)
    while active:
        point = scene.table.point(triangle, barycentric, active)
        odds /= dr.maximum(dr.abs(dr.dot(point.geometric_normal, direction)), SMALLEST_COSINE)
        emits = active & (triangle >= scene.num_surfaces)
        landing = dr.select(depth > 1, odds, 0)
        seen = _seen_emission(scene, point, triangle, direction, distance, density, landing, emits)
        radiance = parts.add(radiance, throughput * seen, depth, share)
        depth += 1
        active &= depth < scene.max_depth
        vertex = _viewed(scene, point, triangle, barycentric, direction, active)
        guidance = _guidance(scene, vertex, active & (depth > 1))
        u = sampler.next_2d(active)
        lit, local = _direct_light(scene, vertex, guidance, odds, depth, u, active)
        lit_share = parts.carried(vertex, local, depth, share)
        radiance = parts.add(radiance, throughput * lit, depth, lit_share)
        u_lobe, u_local = sampler.next_1d(active), sampler.next_2d(active)
        local = _drawn(scene, vertex, guidance, u_lobe, u_local, active)
        reflected, unguided = _reflected(vertex, local)
        density = _density(scene, vertex, guidance, unguided, local, active)
        share = parts.carried(vertex, local, depth, share)
        active &= density > 0
        guided *= _ratio(guidance, density, unguided)
        throughput = dr.select(active, throughput * reflected / density, throughput)
        odds = dr.minimum(odds * _turned_back(vertex, local, depth) / density, MOST_ODDS)
        u_end = sampler.next_1d(active)
        throughput, active = roulette(scene, throughput, depth, u_end, active, guided)
        direction = mi.Vector3f(vertex.frame.to_world(local))
        origin = off_surface(point, direction)
        hit = scene.everything.ray_intersect_preliminary(mi.Ray3f(origin, direction), active=active)
        lit = _missed(scene, direction, density, throughput, active, hit)
        radiance = radiance if lit is None else parts.add(radiance, lit, depth, share)
        active &= hit.is_valid()
        distance, triangle, barycentric = _met(hit)
    return radiance


def _met(hit: Any) -> tuple[Any, Any, Any]:
    """Return the distance, the triangle, and where on it a ray has met it."""
    return mi.Float(hit.t), mi.UInt32(hit.prim_index), mi.Point2f(hit.prim_uv)


def _viewed(
    scene: KernelScene,
    point: SurfacePoint,
    triangle: Any,
    barycentric: Any,
    direction: Any,
    active: Any,
) -> Vertex:
    vertex = vertex_at(scene, point, triangle, barycentric, direction, active)
    albedo = scene.albedo(vertex.incoming.z, vertex.lobes.alpha, active)
    return replace(vertex, lobes=ggx.seen_from(vertex.lobes, vertex.incoming, albedo))


def _seen_emission(
    scene: KernelScene,
    point: SurfacePoint,
    triangle: Any,
    direction: Any,
    distance: Any,
    density: Any,
    landing: Any,
    emits: Any,
) -> Any:
    """Return the emission that a drawn direction ran into, weighed against the other strategies."""
    row = dr.select(emits, triangle - scene.num_surfaces, 0)
    area_density, emitted = scene.emitters.density_and_radiance(row, emits)
    cosine = dr.abs(dr.dot(point.geometric_normal, direction))
    emitter_density = scene.picked(area_density) * dr.square(distance) / cosine
    leaving = scene.cone.density(point.position, point.geometric_normal, -direction)
    others = dr.square(emitter_density / density) + dr.square(landing * area_density * leaving)
    shines = emits & (dr.max(emitted) > 0)  # one that is off has no density: 0/0 at grazing angles
    return dr.select(shines, emitted / (1 + others), 0)


def _background(scene: KernelScene, parts: KernelParts, direction: Any, met: Any) -> list[Any]:
    """Return the sums with what a camera ray sees that meets nothing; it is direct light."""
    if scene.sky is None or not scene.sky.is_seen:
        return parts.dark()
    seen, _ = scene.sky.radiance_and_density(direction, ~met)
    return parts.add(parts.dark(), dr.select(met, 0, seen), mi.UInt32(1), parts.first_share())


def _missed(
    scene: KernelScene, direction: Any, density: Any, throughput: Any, active: Any, hit: Any
) -> Any:
    """Return the sky's light where a drawn direction meets nothing; None where there is no sky."""
    if scene.sky is None:
        return None
    free = active & ~hit.is_valid()
    radiance, picks = scene.sky.radiance_and_density(direction, free)
    return throughput * dr.select(free, radiance / (1 + dr.square(picks / density)), 0)


def _guidance(scene: KernelScene, vertex: Vertex, active: Any) -> Guidance | None:
    if scene.guide is None:
        return None
    place = vertex.triangle, vertex.barycentric, vertex.front
    return scene.guide.at(*place, vertex.lobes, active)


def _drawn(
    scene: KernelScene,
    vertex: Vertex,
    guidance: Guidance | None,
    u_lobe: Any,
    u_local: Any,
    active: Any,
) -> Any:
    """Return the direction (in the frame) in which a path goes on."""
    if scene.guide is None or guidance is None:
        return ggx.sample(vertex.lobes, vertex.incoming, u_lobe, u_local)
    guided = u_lobe < guidance.share
    world = scene.guide.sample(guidance, u_local, active & guided)
    u_rest = (u_lobe - guidance.share) / (1 - guidance.share)
    local = ggx.sample(vertex.lobes, vertex.incoming, u_rest, u_local)
    return mi.Vector3f(dr.select(guided, vertex.frame.to_local(world), local))


def _density(
    scene: KernelScene,
    vertex: Vertex,
    guidance: Guidance | None,
    unguided: Any,
    local: Any,
    active: Any,
) -> Any:
    """Return the density of `_drawn` from that of a BRDF sample."""
    if scene.guide is None or guidance is None:
        return unguided
    return scene.guide.mixture(guidance, unguided, vertex.frame.to_world(local), active)


def _ratio(guidance: Guidance | None, density: Any, unguided: Any) -> Any:
    """Return by how much guiding has changed the density of a direction; 1 if nothing is seen."""
    return 1 if guidance is None else dr.select(unguided > 0, density / unguided, 1)


def _reflected(vertex: Vertex, local: Any) -> tuple[Any, Any]:
    return ggx.evaluate(vertex.lobes, vertex.incoming, local, vertex.geometric)


def _turned_back(vertex: Vertex, local: Any, depth: Any) -> Any:
    """Return C+ r of a light path that comes from `local`; at x1, its end, it draws nothing."""
    drawn = ggx.reverse_density(vertex.lobes, vertex.incoming, local, vertex.geometric)
    return dr.abs(dr.dot(vertex.geometric, local)) * dr.select(depth > 1, drawn, 1)


def _direct_light(
    scene: KernelScene,
    vertex: Vertex,
    guidance: Guidance | None,
    odds: Any,
    depth: Any,
    u: Any,
    active: Any,
) -> tuple[Any, Any]:
    """Return the light of one pick, a point of a lamp or a direction of the sky, and its direction.

    The direction is in the frame. The light is weighed against the other strategies.
    """
    pick = picked_light(scene, vertex.point.position, u, active)
    local = vertex.frame.to_local(pick.direction)
    reflected, unguided = _reflected(vertex, local)
    density = _density(scene, vertex, guidance, unguided, local, active)
    landing = odds * _turned_back(vertex, local, depth) * pick.leaving / pick.distance_sq
    others = dr.square(density / pick.density) + dr.square(dr.select(depth > 1, landing, 0))
    useful = active & (dr.max(reflected) > 0) & dr.isfinite(pick.density)
    shadow_ray = pick.shadow_ray(off_surface(vertex.point, pick.direction))
    lit = useful & ~scene.everything.ray_test(shadow_ray, active=useful)
    weighed = reflected * pick.radiance / (pick.density * (1 + others))
    return dr.select(lit, weighed, 0), local
