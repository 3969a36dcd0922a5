"""Light tracing inside a kernel: paths from the emitters that are joined to the camera.

It finds what the path tracer meets by luck only: light that a glossy surface throws on another one
(caustics, which would be fireflies; no sample is clamped). A path has vertices x1..xk, of which the
camera sees x1 and xk is on an emitter. The path tracer *hits* xk in a direction that it draws or
*picks* it from the table of emitters; a light path sets out from xk and *lands* on x1. Whichever of
the three finds a path is weighed by its density among those of all three (power heuristic, exponent
2: Veach and Guibas 1995): all light is counted once, mostly by the strategy that finds it best.
With

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
import numpy as np

from pipeline.renders import ggx
from pipeline.renders.device_memory import read_back
from pipeline.renders.emitter_table import EmitterPoint
from pipeline.renders.film import Film, Splats
from pipeline.renders.guide_table import GuideCells, GuideTable, Photons, bin_of, rough_share
from pipeline.renders.kernel_scene import (
    MAX_MIS_RATIO,
    SMALLEST_COSINE,
    KernelParts,
    KernelScene,
    Vertex,
    face_viewer,
    next_hit,
    off_surface,
    roulette,
    vertex_at,
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
        record: `CameraJoin` or `PhotonRecords`.
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


class CameraJoin:
    """Adds the light that lands to `splats`: radiance times the samples of a pixel.

    Not a dataclass: Dr.Jit would take its arrays for loop variables.
    """

    def __init__(
        self,
        films: Sequence[Film],
        parts: KernelParts,
        light_paths: Any,
        splats: Sequence[Sequence[Splats]],
    ) -> None:
        """Join each path to some cameras.

        Args:
            films: the cameras that each path is joined to.
            parts: what is kept apart; all light that lands is indirect.
            light_paths: Float, light paths for each sample of a pixel, the same as of `trace`.
            splats: for each camera, the sum of each lobe, or of both.
        """
        self._films = films
        self._parts = parts
        self._light_paths = light_paths
        self._splats = splats

    def __call__(self, scene: KernelScene, arrival: Arrival) -> None:
        """Add the light that reaches a vertex to the pictures in which it shows."""
        visible = arrival.active & (arrival.vertex.hit.triangle < scene.num_surfaces)
        landing = visible & (arrival.depth > 1) & (arrival.depth < scene.max_depth)
        ratio = dr.minimum(dr.hypot(arrival.hit_mis_ratio, arrival.pick_mis_ratio), MAX_MIS_RATIO)
        for film, sums in zip(self._films, self._splats, strict=True):
            sight = mi.Bool(landing)  # each camera narrows its own
            value, share, pixel, lands = self._connect(
                scene, film, arrival.vertex, ratio / self._light_paths, sight
            )
            values = self._parts.by_lobe(arrival.light * value, share)
            for total, part in zip(sums, values, strict=True):
                total.add(part, pixel, lands)

    def _connect(
        self, scene: KernelScene, film: Film, vertex: Vertex, mis_ratio: Any, active: Any
    ) -> tuple[Any, Any, Any, Any]:
        """Return the light of a vertex in the picture: value, diffuse share, pixel and visibility.

        The value and the share of the diffuse lobe are Color3f, the pixel UInt32, visibility Bool.

        Args:
            mis_ratio: Float, the square root of (hit^2 + pick^2) / land^2, without P and c_1.
        """
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
        of_diffuse = self._parts.share(*_flip_to_viewer(scene, vertex, local, active))
        return reflected * (share * pixels / self._light_paths), of_diffuse, pixel, active


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


_SLOTS = 6
"""Vertices of a path that are recorded at most."""

_NARROW = 1.0
"""Least density (per steradian) of a bounce whose arrival is recorded: thrice that of a cosine."""

_LEAST_ROUGH = 0.2
"""Least share of a surface's lobes that may be guided, for an arrival to be recorded."""


class PhotonRecords:
    """Where light arrives by way of narrow lobes; path guiding learns from it (guide_table).

    Arrivals straight from an emitter are not recorded, because the path tracer picks emitters, nor
    those by way of wide lobes, because a BRDF sample finds such light. Not a dataclass: Dr.Jit
    would take its arrays for loop variables.
    """

    def __init__(self, cells: GuideCells, count: int) -> None:
        """Begin with none, for `count` paths."""
        self._guide_cells = cells
        self._first = dr.arange(mi.UInt32, count) * _SLOTS
        self._cells = dr.zeros(mi.UInt32, count * _SLOTS)
        self._bins = dr.zeros(mi.UInt32, count * _SLOTS)
        self._powers = dr.zeros(mi.Float, count * _SLOTS)

    def __call__(self, _: KernelScene, arrival: Arrival) -> None:
        """Record an arrival of each lane in a cell, from the bin of its direction."""
        vertex = arrival.vertex
        cell = self._guide_cells.index(vertex.hit, vertex.front, arrival.active)
        index, _ = bin_of(-arrival.direction)
        reflects = dr.max(vertex.lobes.diffuse + vertex.lobes.specular) > 0
        arrives = arrival.active & (arrival.drawn > _NARROW) & reflects
        arrives &= rough_share(vertex.lobes) > _LEAST_ROUGH
        slot = arrival.depth - 2
        active = arrives & (slot < _SLOTS)
        place = self._first + slot
        dr.scatter(self._cells, cell, place, active)
        dr.scatter(self._bins, index, place, active)
        dr.scatter(self._powers, arrival.power, place, active)

    def photons(self) -> Photons:
        """Return all that was recorded, path by path."""
        powers = read_back(self._powers).astype(np.float64)
        rows = np.flatnonzero((powers > 0) & np.isfinite(powers))
        cell, number = (read_back(v)[rows].astype(np.int64) for v in (self._cells, self._bins))
        return Photons(cell=cell, bin=number, power=powers[rows])
