"""One scene as kernels see it, and the surface code that both kinds of paths share."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders.emission_cone import EmissionCone
from pipeline.renders.emitter_table import EmitterTable
from pipeline.renders.ggx import AlbedoLookup, KernelLobes
from pipeline.renders.guide_table import GuideTable
from pipeline.renders.sky_table import SkyTable
from pipeline.renders.surface_table import SurfacePoint, SurfaceTable

MAX_SURVIVAL = 0.95
"""Largest probability to survive roulette, so that paths between bright surfaces end."""

SMALLEST_COSINE = 1e-9
"""Cosines that weights divide by are at least this: a path along a surface carries no light."""

MAX_MIS_RATIO = 1e18
"""Ratios of densities are capped here: their squares stay finite, and 0 times those is not NaN."""

_OFFSET = 1500 * 2.0**-24
"""Relative distance of a ray's start from its surface, as in Mitsuba: 1500 float32 roundings."""


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
        cone: EmissionCone,
        num_surfaces: int,
        max_depth: int,
        rr_depth: int,
        guide: GuideTable | None = None,
        sky: SkyTable | None = None,
    ) -> None:
        """Combine the tables.

        Args:
            surfaces: mi.Scene without emitters: what camera rays meet.
            everything: mi.Scene with emitters: what all other rays meet.
            table: geometry and materials of all triangles.
            emitters: the emitting ones.
            cone: the directions in which light paths leave them.
            num_surfaces: the first triangle number that emits.
            max_depth: longest path in edges.
            rr_depth: edges after which a path goes on by Russian roulette.
            guide: the directions in which camera paths look for light; None: by the BRDF alone.
            sky: the environment map; None compiles a kernel without one.
        """
        self.surfaces = surfaces
        self.everything = everything
        self.table = table
        self.emitters = emitters
        self.cone = cone
        self.guide = guide
        self.sky = sky
        self.albedo = AlbedoLookup()
        self.num_surfaces = dr.opaque(mi.UInt32, num_surfaces)
        self.max_depth = dr.opaque(mi.UInt32, max_depth)
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)

    def to_pick_pdf(self, pdf: Any) -> Any:
        """Return a density among lamps (Float) as a density among lamps and sky."""
        return pdf if self.sky is None else self.sky.of_lamps(pdf)


@dataclass(frozen=True, kw_only=True, eq=False)
class Vertex:
    """A vertex of a path, lane by lane."""

    point: SurfacePoint
    triangle: Any
    """Triangle number, UInt32; surfaces first, then emitters."""
    barycentric: Any
    """Weights of the 2nd and 3rd corner, Point2f."""
    front: Any
    """True where the ray hit the front of the triangle by its winding, Bool."""
    frame: Any
    """Shading frame, flipped with the triangle to face the incoming ray, Frame3f."""
    geometric: Any
    """Normal of the triangle on the side of the incoming ray, in the frame, Vector3f."""
    incoming: Any
    """Direction to the previous vertex, in the frame, Vector3f."""
    lobes: KernelLobes


def vertex_at(
    scene: KernelScene,
    point: SurfacePoint,
    triangle: Any,
    barycentric: Any,
    direction: Any,
    active: Any,
) -> Vertex:
    """Return the vertex, seen from the side of the triangle that the ray comes from."""
    normal, lobes = scene.table.shading(triangle, barycentric, active)
    geometric = dr.mulsign(point.geometric_normal, dr.dot(point.geometric_normal, normal))
    behind = dr.dot(geometric, direction) > 0
    frame = mi.Frame3f(dr.select(behind, -normal, normal))
    return Vertex(
        point=point,
        triangle=triangle,
        barycentric=barycentric,
        front=dr.dot(point.geometric_normal, direction) < 0,
        frame=frame,
        geometric=frame.to_local(dr.select(behind, -geometric, geometric)),
        incoming=frame.to_local(-direction),
        lobes=lobes,
    )


def off_surface(point: SurfacePoint, direction: Any) -> Any:
    """Return the start (Point3f) of a ray that leaves the surface on the side of `direction`."""
    offset = (1 + dr.max(dr.abs(point.position))) * _OFFSET
    side = dr.mulsign(mi.Float(offset), dr.dot(point.geometric_normal, direction))
    return mi.Point3f(point.position + point.geometric_normal * side)


def roulette(
    scene: KernelScene, throughput: Any, depth: Any, u: Any, active: Any, guided: Any = 1.0
) -> tuple[Any, Any]:
    """Return the throughput (Color3f) of paths that go on after `depth` edges, and which do.

    Args:
        scene: the scene.
        throughput: Color3f.
        depth: UInt32.
        u: Float, uniform.
        active: the paths in question.
        guided: Float, the density of the directions of a guided path divided by that of BRDF
            samples. A guided path has a small throughput because it goes where the light is: if
            that ended it, guiding would gain nothing (Vorba and Krivanek 2016). So it survives by
            the throughput that it would have had without guiding.
    """
    plays = depth >= scene.rr_depth
    survival = dr.minimum(dr.max(throughput) * guided, MAX_SURVIVAL)
    active &= ~plays | (u < survival)
    throughput = dr.select(plays & active, throughput / survival, throughput)
    return throughput, active & (dr.max(throughput) > 0)
