"""The path tracer inside a kernel: emitter sampling and BRDF sampling, weighed against each other.

Per path it does what Mitsuba's `path` integrator does with `hide_emitters` (same depth count, same
roulette), for the one kind of surface and the one kind of emitter that a `Scene` has. An emitter
reflects as any surface does, by its material row, and what is black ends the path. Leaving out
virtual calls makes it 1.8 times as fast (LOG.md), and one kernel serves every scene, view and
number of emitters.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders import ggx
from pipeline.renders.emitter_table import EmitterTable
from pipeline.renders.ggx import AlbedoLookup, KernelLobes
from pipeline.renders.surface_table import SurfacePoint, SurfaceTable

_MAX_SURVIVAL = 0.95
"""A path never survives roulette for sure, so that bright loops end."""

_OFFSET = 1500 * 2.0**-24
"""Relative distance of a ray's start from its surface, as in Mitsuba: 1500 float32 roundings."""

_SHORTENING = 1e-4
"""Relative length that a shadow ray stops short of its emitter, so that it does not hit it."""


class KernelScene:
    """One scene as kernels see it. Triangle numbers of `everything` put surfaces first.

    Not a dataclass: Dr.Jit would take its arrays for variables of the loop.
    """

    def __init__(
        self,
        *,
        surfaces: Any,
        everything: Any,
        table: SurfaceTable,
        emitters: EmitterTable,
        num_surfaces: int,
        max_depth: int,
        rr_depth: int,
    ) -> None:
        """Bring the parts together.

        Args:
            surfaces: mi.Scene without emitters: what camera rays meet.
            everything: mi.Scene with emitters: what all other rays meet.
            table: geometry and materials of all triangles.
            emitters: the emitting ones.
            num_surfaces: the first triangle number that emits.
            max_depth: longest path in edges.
            rr_depth: edges after which a path goes on by Russian roulette.
        """
        self.surfaces = surfaces
        self.everything = everything
        self.table = table
        self.emitters = emitters
        self.albedo = AlbedoLookup()
        self.num_surfaces = dr.opaque(mi.UInt32, num_surfaces)
        self.max_depth = dr.opaque(mi.UInt32, max_depth)
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Vertex:
    """A vertex of the path, lane by lane."""

    point: SurfacePoint
    frame: Any
    """Frame3f: shading frame, turned over with the triangle to face the incoming ray."""
    geometric: Any
    """Vector3f: normal of the triangle on the side of the incoming ray, in the frame."""
    incoming: Any
    """Vector3f: where the path came from, in the frame."""
    lobes: KernelLobes


@dr.syntax
def trace(scene: KernelScene, sampler: Any, ray: Any) -> Any:
    """Return the radiance (Color3f) along camera rays; emitters themselves are not seen."""
    hit = scene.surfaces.ray_intersect_preliminary(ray, coherent=True)
    active = mi.Bool(hit.is_valid())
    distance, triangle = mi.Float(hit.t), mi.UInt32(hit.prim_index)
    barycentric = mi.Point2f(hit.prim_uv)
    origin, direction = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    radiance, throughput = mi.Color3f(0), mi.Color3f(1)
    density, depth = mi.Float(0), mi.UInt32(0)
    while active:
        point = scene.table.point(triangle, barycentric, active)
        emits = active & (triangle >= scene.num_surfaces)
        seen = _seen_emission(scene, point, triangle, direction, distance, density, emits)
        radiance += throughput * seen
        depth += 1
        active &= depth < scene.max_depth
        vertex = _vertex(scene, point, triangle, barycentric, direction, active)
        lit = _direct_light(scene, vertex, sampler.next_2d(active), active)
        radiance += throughput * lit
        local = ggx.sample(
            vertex.lobes, vertex.incoming, sampler.next_1d(active), sampler.next_2d(active)
        )
        reflected, density = _reflected(vertex, local)
        active &= density > 0
        throughput = dr.select(active, throughput * reflected / density, throughput)
        roulette = depth >= scene.rr_depth
        survival = dr.minimum(dr.max(throughput), _MAX_SURVIVAL)
        active &= ~roulette | (sampler.next_1d(active) < survival)
        throughput = dr.select(roulette & active, throughput / survival, throughput)
        active &= dr.max(throughput) > 0
        direction = mi.Vector3f(vertex.frame.to_world(local))
        origin = _off_surface(point, direction)
        hit = scene.everything.ray_intersect_preliminary(mi.Ray3f(origin, direction), active=active)
        active &= hit.is_valid()
        distance, triangle = mi.Float(hit.t), mi.UInt32(hit.prim_index)
        barycentric = mi.Point2f(hit.prim_uv)
    return radiance


def _seen_emission(
    scene: KernelScene,
    point: SurfacePoint,
    triangle: Any,
    direction: Any,
    distance: Any,
    density: Any,
    emits: Any,
) -> Any:
    """Return the emission that a BRDF sample ran into, weighed against emitter sampling."""
    row = dr.select(emits, triangle - scene.num_surfaces, 0)
    area_density, emitted = scene.emitters.density_and_radiance(row, emits)
    cosine = dr.abs(dr.dot(point.geometric_normal, direction))
    emitter_density = area_density * dr.square(distance) / cosine
    shines = emits & (dr.max(emitted) > 0)  # one that is off has no density: 0/0 at grazing angles
    return dr.select(shines, emitted * (density / (density + emitter_density)), 0)


def _vertex(
    scene: KernelScene,
    point: SurfacePoint,
    triangle: Any,
    barycentric: Any,
    direction: Any,
    active: Any,
) -> _Vertex:
    """Return the vertex, seen from the side of the triangle that the ray comes from."""
    normal, lobes = scene.table.shading(triangle, barycentric, active)
    geometric = dr.mulsign(point.geometric_normal, dr.dot(point.geometric_normal, normal))
    behind = dr.dot(geometric, direction) > 0
    frame = mi.Frame3f(dr.select(behind, -normal, normal))
    incoming = frame.to_local(-direction)
    albedo = scene.albedo(incoming.z, lobes.alpha, active)
    return _Vertex(
        point=point,
        frame=frame,
        geometric=frame.to_local(dr.select(behind, -geometric, geometric)),
        incoming=incoming,
        lobes=ggx.seen_from(lobes, incoming, albedo),
    )


def _reflected(vertex: _Vertex, local: Any) -> tuple[Any, Any]:
    return ggx.evaluate(vertex.lobes, vertex.incoming, local, vertex.geometric)


def _direct_light(scene: KernelScene, vertex: _Vertex, u: Any, active: Any) -> Any:
    """Return the light of one sampled emitter point, weighed against BRDF sampling."""
    emitter = scene.emitters.sample(u, active)
    to_emitter = emitter.position - vertex.point.position
    distance_sq = dr.squared_norm(to_emitter)
    direction = to_emitter * dr.rsqrt(distance_sq)
    emitter_density = emitter.area_density * distance_sq / dr.abs(dr.dot(emitter.normal, direction))
    reflected, density = _reflected(vertex, vertex.frame.to_local(direction))
    useful = active & (dr.max(reflected) > 0) & dr.isfinite(emitter_density)
    start = _off_surface(vertex.point, direction)
    remaining = emitter.position - start
    length = dr.norm(remaining)
    shadow_ray = mi.Ray3f(start, mi.Vector3f(remaining / length))
    shadow_ray.maxt = length * (1 - _SHORTENING)
    lit = useful & ~scene.everything.ray_test(shadow_ray, active=useful)
    return dr.select(lit, reflected * emitter.radiance / (emitter_density + density), 0)


def _off_surface(point: SurfacePoint, direction: Any) -> Any:
    """Return the start of a ray that leaves the surface on the side of `direction`."""
    offset = (1 + dr.max(dr.abs(point.position))) * _OFFSET
    side = dr.mulsign(mi.Float(offset), dr.dot(point.geometric_normal, direction))
    return mi.Point3f(point.position + point.geometric_normal * side)
