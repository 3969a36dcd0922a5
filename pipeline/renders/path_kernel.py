"""The path tracer inside kernels: emitter and BRDF sampling by multiple importance sampling (MIS).

Per path it does what Mitsuba's `path` integrator does with `hide_emitters` (same depth count, same
roulette), for the one kind of surface and the one kind of emitter that a `Scene` has. An emitter
reflects as any surface does, by its material row, and what is black ends the path. Leaving out
virtual calls makes it 1.8 times as fast (study S1), and one kernel serves every scene, view and
number of emitters.

Both are weighed against light tracing too, unless there are no light paths. Where the scene has a
guide, half of the directions of rough surfaces come from its table (pipeline.renders.guide_table),
which makes another kernel. So does an environment map (pipeline.renders.light_tables): picks go to
it in a stated share, and what meets nothing finds it.

Light paths begin on the emitters and are joined to the camera. They find what the path tracer meets
by luck only: light that a glossy surface throws on another one (caustics, which would be fireflies;
no sample is clamped). A path has vertices x1..xk, of which the camera sees x1 and xk is on an
emitter. The path tracer *hits* xk in a direction that it draws or *picks* it from the table of
emitters; a light path sets out from xk and *lands* on x1. Whichever of the three finds a path is
weighed by its density among those of all three (power heuristic, exponent 2: Veach and Guibas
1995): all light is counted once, mostly by the strategy that finds it best. With

    P      pixels per area at x1              L      light paths for each sample of a pixel
    a, e   densities with which a light path picks xk (per area) and leaves it (per steradian)
    c_i    density (per steradian) with which the path tracer draws the direction from x_i towards
           x_(i+1): of a BRDF sample, and where the path is guided (i > 1) of the mixture of those
           with directions from pipeline.renders.guide_table
    r_i    that of a light path, towards x_(i-1)
    C+_i, C-_i   cosines of the triangle's normal at x_i to x_(i+1) and to x_(i-1)
    d_i    distance from x_i to x_(i+1)

the densities, per area at each vertex, are

    hit  = P * product over i < k of c_i C-_(i+1) / d_i^2
    pick = hit * a d_(k-1)^2 / (c_(k-1) C-_k)
    land = L a e * product over i < k of C+_i / d_i^2 * product over 1 < i < k of r_i

The path tracer carries the ratio L / P * product of C+_i r_i / (c_i C-_(i+1)), a light path its
inverse, once for `hit` and once for `pick`. Roulette is in none of them. Direct light (k = 2) never
lands: the stratified picks of the path tracer had 4 to 25 times less variance there (study S6).

Light from an environment map is found by the path tracer alone: its paths have no third density.
Where there is one, `pick` goes by the share of the lamps too, and `land` does not.

The BRDF is not reciprocal: in a light path the viewer's side is that of the next vertex. Light
arrives by the cosine of the shading normal but spreads by that of the triangle, hence a factor
C-/C+ at each vertex (Veach 1996).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders import ggx
from pipeline.renders.film import Film, Splats
from pipeline.renders.guide_table import Guidance, GuideTable
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
from pipeline.renders.light_tables import EmitterPoint
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
    # the ratio L / P * product of C+_i r_i / (c_i C-_(i+1)) of the module's head
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


@dataclass(frozen=True, eq=False)
class Arrival:
    """Light that arrives at a vertex of a light path, lane by lane."""

    vertex: Vertex
    direction: Any
    """Direction in which the light arrives, Vector3f."""
    power: Any
    """Mean of the channels of the power before `vertex` spreads it, Float."""
    light: Any
    """Color3f: what a viewer's cosine and BRDF are multiplied by."""
    hit_mis_ratio: Any
    pick_mis_ratio: Any
    """Float: densities of `hit` and `pick` over that of `land`, without P, L and c_1."""
    drawn: Any
    """Density (Float, per steradian) of the direction of the last bounce; 0 before the first."""
    depth: Any
    """Vertices on surfaces so far, UInt32."""
    active: Any


@dr.syntax
def trace_light(
    scene: KernelScene,
    emitter: EmitterPoint,
    u_direction: Any,
    sampler: Any,
    record: Callable[[KernelScene, Arrival], None],
) -> None:
    """Trace paths from the emitters, and hand over every arrival at a surface.

    Args:
        emitter: where the path of each lane begins.
        u_direction: Point2f, uniform, for the directions in which they leave.
        sampler: mi.Sampler with a lane for each path.
        record: `join_to_cameras` with its cameras, or `PhotonRecords`.
    """
    direction = scene.cone.sample(emitter.position, emitter.geometric_normal, u_direction)
    leaving = scene.cone.pdf(emitter.position, emitter.geometric_normal, direction)
    cosine = dr.abs(dr.dot(emitter.geometric_normal, direction))
    active = mi.Bool((leaving > 0) & (dr.max(emitter.radiance) > 0))
    hit_mis_ratio = mi.Float(cosine / (emitter.area_pdf * leaving))  # C+ / (a e)
    strength = dr.max(emitter.radiance) * hit_mis_ratio
    throughput = mi.Color3f(emitter.radiance / dr.max(emitter.radiance))
    hit, is_met = next_hit(scene, emitter, direction, active)
    active &= is_met
    pick_mis_ratio = mi.Float(scene.to_pick_pdf(dr.square(hit.distance) / leaving))
    drawn = mi.Float(0)
    depth = mi.UInt32(1)
    while active:
        point = scene.table.point(hit, active)
        vertex = vertex_at(scene, point, hit, direction, active)
        power = dr.mean(throughput) * strength
        spread = dr.maximum(dr.dot(vertex.geometric, vertex.incoming), SMALLEST_COSINE)
        throughput = throughput / spread
        hit_mis_ratio = hit_mis_ratio / spread
        pick_mis_ratio = pick_mis_ratio / spread
        light = throughput * strength
        ratios = hit_mis_ratio, pick_mis_ratio
        record(scene, Arrival(vertex, direction, power, light, *ratios, drawn, depth, active))
        depth += 1
        active &= depth < scene.max_depth
        u_lobe = sampler.next_1d(active)
        u_local = sampler.next_2d(active)
        local, reflected, forward, ratio = bounce(scene, vertex, u_lobe, u_local, active)
        throughput *= reflected * ratio
        hit_mis_ratio = dr.minimum(hit_mis_ratio * forward * ratio, MAX_MIS_RATIO)
        onwards = dr.select(depth == 2, 1, forward)  # from x_(k-1) a path is picked, not drawn
        pick_mis_ratio = dr.minimum(pick_mis_ratio * onwards * ratio, MAX_MIS_RATIO)
        throughput, active = roulette(scene, throughput, depth, sampler.next_1d(active), active)
        drawn = dr.abs(dr.dot(vertex.geometric, local)) / ratio
        direction = mi.Vector3f(vertex.frame.to_world(local))
        hit, is_met = next_hit(scene, point, direction, active)
        active &= is_met


def join_to_cameras(
    films: Sequence[Film],
    parts: KernelParts,
    light_paths: Any,
    splats: Sequence[Sequence[Splats]],
    scene: KernelScene,
    arrival: Arrival,
) -> None:
    """Add the light that lands to `splats`: radiance times the samples of a pixel.

    Args:
        films: the cameras that each path is joined to.
        parts: what is kept apart; all light that lands is indirect.
        light_paths: Float, light paths for each sample of a pixel, the same as of `trace`.
        splats: for each camera, the sum of each lobe, or of both.
        scene: of the paths.
        arrival: their vertices, of which those that a picture shows add to it.
    """
    vertex = arrival.vertex
    visible = arrival.active & (vertex.hit.triangle < scene.num_surfaces)
    landing = visible & (arrival.depth > 1) & (arrival.depth < scene.max_depth)
    ratio = dr.minimum(dr.hypot(arrival.hit_mis_ratio, arrival.pick_mis_ratio), MAX_MIS_RATIO)
    # the square root of (hit^2 + pick^2) / land^2, without P and c_1
    mis_ratio = ratio / light_paths
    for film, sums in zip(films, splats, strict=True):
        active = mi.Bool(landing)  # each camera narrows its own
        to_camera = film.origin - vertex.point.position
        distance_sq = dr.squared_norm(to_camera)
        direction = to_camera * dr.rsqrt(distance_sq)
        local = vertex.frame.to_local(direction)
        reflected, forward, _ = _evaluate_brdf(scene, vertex, local, active, None)
        pixels = film.pdf(-direction) * dr.abs(dr.dot(vertex.geometric, local)) / distance_sq
        share = 1 / (1 + dr.square(pixels * mis_ratio * forward))
        pixel, inside = film.pixel(vertex.point.position)
        active &= inside & (dr.max(reflected) > 0)
        start = off_surface(vertex.point, to_camera)
        remaining = film.origin - start
        ray = mi.Ray3f(start, mi.Vector3f(dr.normalize(remaining)))
        ray.maxt = dr.norm(remaining)
        active &= ~scene.surfaces.ray_test(ray, active=active)
        of_diffuse = parts.share(*_flip_to_viewer(scene, vertex, local, active))
        value = reflected * (share * pixels / light_paths)
        values = parts.by_lobe(arrival.light * value, of_diffuse)
        for total, part in zip(sums, values, strict=True):
            total.add(part, pixel, active)


def bounce(
    scene: KernelScene, vertex: Vertex, u_lobe: Any, u_direction: Any, active: Any
) -> tuple[Any, Any, Any, Any]:
    """Return a direction (in the frame), f and c of a viewer there, and C- / r (0: absorbed)."""
    faced = dr.select(vertex.incoming.z > 0, vertex.lobes.weight, 0)
    lobes = replace(vertex.lobes, weight=faced)
    local = ggx.sample(lobes, vertex.incoming, u_lobe, u_direction)
    reflected, forward, drawn = _evaluate_brdf(scene, vertex, local, active, scene.guide)
    across = dr.abs(dr.dot(vertex.geometric, local))
    return local, reflected, forward, dr.select(active & (drawn > 0), across / drawn, 0)


def _evaluate_brdf(
    scene: KernelScene, vertex: Vertex, view: Any, active: Any, guide: GuideTable | None
) -> tuple[Any, Any, Any]:
    """Return f cos (Color3f), c and r for light that comes from `incoming` and goes to `view`.

    `guide` is the guide table of the viewer's path.
    """
    seen, wo = _flip_to_viewer(scene, vertex, view, active)
    reflected, pdf = seen.evaluate(wo)
    if guide is not None:
        to_light = vertex.frame.to_world(vertex.incoming)
        guidance = guide.at(seen.hit, seen.front, seen.lobes, active)
        pdf = guidance.mixture(pdf, to_light, active)
    return reflected, pdf, seen.reverse_pdf(wo)


def _flip_to_viewer(
    scene: KernelScene, vertex: Vertex, view: Any, active: Any
) -> tuple[Vertex, Any]:
    """Return the vertex as a viewer in direction `view` has it, and where light comes from.

    The surface is turned to the side of the viewer, as the path tracer has it. The BRDF is the same
    around the normal, so that mirroring z is enough. Mapped normals then face the viewer.
    """
    side = dr.mulsign(mi.Float(1), dr.dot(vertex.geometric, view))
    flip = mi.Vector3f(1, 1, side)
    turned_over = replace(
        vertex,
        incoming=view * flip,
        geometric=vertex.geometric * flip * side,
        unmapped=None if vertex.unmapped is None else vertex.unmapped * flip * side,
        front=vertex.front ^ (side < 0),
    )
    seen, (wo,) = face_viewer(scene, turned_over, active, vertex.incoming * flip)
    return seen, wo
