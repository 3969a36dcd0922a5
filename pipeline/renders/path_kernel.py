"""The path tracer inside a kernel: emitter sampling and BRDF sampling, weighed against each other.

Per path it does what Mitsuba's `path` integrator does with `hide_emitters` (same depth count, same
roulette), for the one kind of surface and the one kind of emitter that a `Scene` has. An emitter
reflects as any surface does, by its material row, and what is black ends the path. Leaving out
virtual calls makes it 1.8 times as fast (docs/log), and one kernel serves every scene, view and
number of emitters.

Both are weighed against light tracing too (pipeline.renders.light_kernel has the formulas), unless
there are no light paths.
"""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders import ggx
from pipeline.renders.film import Film
from pipeline.renders.kernel_scene import (
    MOST_ODDS,
    SMALLEST_COSINE,
    KernelScene,
    Vertex,
    off_surface,
    roulette,
    vertex_at,
)
from pipeline.renders.surface_table import SurfacePoint

_SHORTENING = 1e-4
"""Relative length that a shadow ray stops short of its emitter, so that it does not hit it."""


@dr.syntax
def trace(scene: KernelScene, film: Film, light_paths: Any, sampler: Any, ray: Any) -> Any:
    """Return the radiance (Color3f) along camera rays; emitters themselves are not seen.

    Args:
        scene: the scene.
        film: the camera.
        light_paths: Float, light paths for each sample of a pixel. What they may find is left out
            in proportion.
        sampler: mi.Sampler with a lane for each ray.
        ray: Ray3f from `film`.
    """
    hit = scene.surfaces.ray_intersect_preliminary(ray, coherent=True)
    active = mi.Bool(hit.is_valid())
    distance, triangle = mi.Float(hit.t), mi.UInt32(hit.prim_index)
    barycentric = mi.Point2f(hit.prim_uv)
    origin, direction = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    radiance, throughput = mi.Color3f(0), mi.Color3f(1)
    density, depth = mi.Float(0), mi.UInt32(0)
    odds = light_paths * dr.square(distance) / film.density(direction)
    while active:
        point = scene.table.point(triangle, barycentric, active)
        odds /= dr.maximum(dr.abs(dr.dot(point.geometric_normal, direction)), SMALLEST_COSINE)
        emits = active & (triangle >= scene.num_surfaces)
        landing = dr.select(depth > 1, odds, 0)
        seen = _seen_emission(scene, point, triangle, direction, distance, density, landing, emits)
        radiance += throughput * seen
        depth += 1
        active &= depth < scene.max_depth
        vertex = vertex_at(scene, point, triangle, barycentric, direction, active)
        vertex = _viewed(scene, vertex, active)
        lit = _direct_light(scene, vertex, odds, depth, sampler.next_2d(active), active)
        radiance += throughput * lit
        local = ggx.sample(
            vertex.lobes, vertex.incoming, sampler.next_1d(active), sampler.next_2d(active)
        )
        reflected, density = _reflected(vertex, local)
        active &= density > 0
        throughput = dr.select(active, throughput * reflected / density, throughput)
        odds = dr.minimum(odds * _turned_back(vertex, local, depth) / density, MOST_ODDS)
        throughput, active = roulette(scene, throughput, depth, sampler.next_1d(active), active)
        direction = mi.Vector3f(vertex.frame.to_world(local))
        origin = off_surface(point, direction)
        hit = scene.everything.ray_intersect_preliminary(mi.Ray3f(origin, direction), active=active)
        active &= hit.is_valid()
        distance, triangle = mi.Float(hit.t), mi.UInt32(hit.prim_index)
        barycentric = mi.Point2f(hit.prim_uv)
    return radiance


def _viewed(scene: KernelScene, vertex: Vertex, active: Any) -> Vertex:
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
    """Return the emission that a BRDF sample ran into, weighed against the other strategies."""
    row = dr.select(emits, triangle - scene.num_surfaces, 0)
    area_density, emitted = scene.emitters.density_and_radiance(row, emits)
    cosine = dr.abs(dr.dot(point.geometric_normal, direction))
    emitter_density = area_density * dr.square(distance) / cosine
    leaving = scene.cone.density(point.position, point.geometric_normal, -direction)
    others = dr.square(emitter_density / density) + dr.square(landing * area_density * leaving)
    shines = emits & (dr.max(emitted) > 0)  # one that is off has no density: 0/0 at grazing angles
    return dr.select(shines, emitted / (1 + others), 0)


def _reflected(vertex: Vertex, local: Any) -> tuple[Any, Any]:
    return ggx.evaluate(vertex.lobes, vertex.incoming, local, vertex.geometric)


def _turned_back(vertex: Vertex, local: Any, depth: Any) -> Any:
    """Return C+ r of a light path that comes from `local`; at x1, its end, it draws nothing."""
    drawn = ggx.reverse_density(vertex.lobes, vertex.incoming, local, vertex.geometric)
    return dr.abs(dr.dot(vertex.geometric, local)) * dr.select(depth > 1, drawn, 1)


def _direct_light(
    scene: KernelScene, vertex: Vertex, odds: Any, depth: Any, u: Any, active: Any
) -> Any:
    """Return the light of one sampled emitter point, weighed against the other strategies."""
    emitter = scene.emitters.sample(u, active)
    to_emitter = emitter.position - vertex.point.position
    distance_sq = dr.squared_norm(to_emitter)
    direction = to_emitter * dr.rsqrt(distance_sq)
    emitter_density = emitter.area_density * distance_sq / dr.abs(dr.dot(emitter.normal, direction))
    local = vertex.frame.to_local(direction)
    reflected, density = _reflected(vertex, local)
    leaving = scene.cone.density(emitter.position, emitter.normal, -direction)
    landing = odds * _turned_back(vertex, local, depth) * leaving / distance_sq
    others = dr.square(density / emitter_density) + dr.square(dr.select(depth > 1, landing, 0))
    useful = active & (dr.max(reflected) > 0) & dr.isfinite(emitter_density)
    start = off_surface(vertex.point, direction)
    remaining = emitter.position - start
    length = dr.norm(remaining)
    shadow_ray = mi.Ray3f(start, mi.Vector3f(remaining / length))
    shadow_ray.maxt = length * (1 - _SHORTENING)
    lit = useful & ~scene.everything.ray_test(shadow_ray, active=useful)
    return dr.select(lit, reflected * emitter.radiance / (emitter_density * (1 + others)), 0)
