"""Light paths that no camera sees: they record where light arrives by way of narrow lobes.

Path guiding learns from them (pipeline.renders.guide_learning). Arrivals straight from an emitter
are not recorded, because the path tracer picks emitters, nor those by way of wide lobes, because a
BRDF sample finds such light.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pipeline.renders.device_memory import read_back
from pipeline.renders.emitter_table import EmitterPoint
from pipeline.renders.guide_cells import GuideCells
from pipeline.renders.guide_learning import Photons
from pipeline.renders.guide_table import bin_of, rough_share
from pipeline.renders.kernel_scene import (
    SMALLEST_COSINE,
    KernelScene,
    off_surface,
    roulette,
    vertex_at,
)
from pipeline.renders.light_kernel import bounce
from pipeline.renders.surface_table import SurfacePoint

_SLOTS = 6
"""Vertices of a path that are recorded at most."""

_NARROW = 1.0
"""Least density (per steradian) of a bounce whose arrival is recorded: thrice that of a cosine."""

_LEAST_ROUGH = 0.2
"""Least share of a surface's lobes that may be guided, for an arrival to be recorded."""


class PhotonRecords:
    """Arrivals of each lane. Not a dataclass: Dr.Jit would take its arrays for loop variables."""

    def __init__(self, count: int) -> None:
        """Begin with none, for `count` paths."""
        self._first = dr.arange(mi.UInt32, count) * _SLOTS
        self._cells = dr.zeros(mi.UInt32, count * _SLOTS)
        self._bins = dr.zeros(mi.UInt32, count * _SLOTS)
        self._powers = dr.zeros(mi.Float, count * _SLOTS)

    def add(self, slot: Any, cell: Any, index: Any, power: Any, active: Any) -> None:
        """Record an arrival of each lane in a cell, from the direction of a bin (UInt32)."""
        active = active & (slot < _SLOTS)
        place = self._first + slot
        dr.scatter(self._cells, cell, place, active)
        dr.scatter(self._bins, index, place, active)
        dr.scatter(self._powers, power, place, active)

    def photons(self) -> Photons:
        """Return all that was recorded, path by path."""
        powers = read_back(self._powers).astype(np.float64)
        rows = np.flatnonzero((powers > 0) & np.isfinite(powers))
        cell, number = (read_back(v)[rows].astype(np.int64) for v in (self._cells, self._bins))
        return Photons(cell=cell, bin=number, power=powers[rows])


@dr.syntax
def trace_photons(
    scene: KernelScene,
    cells: GuideCells,
    emitter: EmitterPoint,
    u_direction: Any,
    sampler: Any,
    records: PhotonRecords,
) -> None:
    """Add arrivals to `records`; see `trace_light` for the arguments that they share."""
    direction = scene.cone.sample(emitter.position, emitter.normal, u_direction)
    leaving = scene.cone.pdf(emitter.position, emitter.normal, direction)
    cosine = dr.abs(dr.dot(emitter.normal, direction))
    active = mi.Bool((leaving > 0) & (dr.max(emitter.radiance) > 0))
    strength = dr.max(emitter.radiance) * cosine / (emitter.area_pdf * leaving)
    throughput = mi.Color3f(emitter.radiance / dr.max(emitter.radiance))
    start = SurfacePoint(position=emitter.position, geometric_normal=emitter.normal)
    ray = mi.Ray3f(off_surface(start, direction), direction)
    hit = scene.everything.ray_intersect_preliminary(ray, active=active)
    active &= hit.is_valid()
    triangle = mi.UInt32(hit.prim_index)
    barycentric = mi.Point2f(hit.prim_uv)
    depth = mi.UInt32(1)
    drawn = mi.Float(0)
    while active:
        point = scene.table.point(triangle, barycentric, active)
        vertex = vertex_at(scene, point, triangle, barycentric, direction, active)
        cell = cells.index(triangle, barycentric, vertex.front, active)
        index, _ = bin_of(-direction)
        reflects = dr.max(vertex.lobes.diffuse + vertex.lobes.specular) > 0
        arrives = active & (drawn > _NARROW) & (rough_share(vertex.lobes) > _LEAST_ROUGH) & reflects
        power = dr.mean(throughput) * strength
        records.add(depth - 2, cell, index, power, arrives)
        spread = dr.maximum(dr.dot(vertex.geometric, vertex.incoming), SMALLEST_COSINE)
        throughput /= spread
        depth += 1
        active &= depth < scene.max_depth
        u_lobe = sampler.next_1d(active)
        u_local = sampler.next_2d(active)
        local, reflected, _, ratio = bounce(scene, vertex, u_lobe, u_local, active)
        throughput *= reflected * ratio
        throughput, active = roulette(scene, throughput, depth, sampler.next_1d(active), active)
        drawn = dr.abs(dr.dot(vertex.geometric, local)) / ratio
        direction = mi.Vector3f(vertex.frame.to_world(local))
        ray = mi.Ray3f(off_surface(point, direction), direction)
        hit = scene.everything.ray_intersect_preliminary(ray, active=active)
        active &= hit.is_valid()
        triangle = mi.UInt32(hit.prim_index)
        barycentric = mi.Point2f(hit.prim_uv)
