"""One scene as Mitsuba and our kernels see it, and the surface code that all paths share."""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders import ggx
from pipeline.renders.device_memory import own_floats, own_integers, read_back
from pipeline.renders.ggx import AlbedoLookup, KernelLobes
from pipeline.renders.guide_table import GuideTable
from pipeline.renders.light_tables import EmissionCone, EmitterTable, SkyTable, sky_share
from pipeline.renders.surface_table import Hit, SurfacePoint, SurfaceTable
from pipeline.renders.tracer import split_triangles
from storage.raycast import MISS, RayHits
from storage.records.lights import part_names, shining_sky
from storage.records.scene import Scene

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

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int) -> None:
        """Load a scene.

        Args:
            max_depth: longest path in edges.
            rr_depth: edges after which a path goes on by Russian roulette.

        Raises:
            Rejected: "unlit_scene" where nothing lights it.
        """
        surfaces, emitters = split_triangles(scene)
        order = np.concatenate([surfaces, emitters])
        sky = shining_sky(scene)
        self.surfaces = build_mitsuba_scene(scene, surfaces)
        """mi.Scene without emitters: what camera rays meet."""
        self.everything = build_mitsuba_scene(scene, order, child=self.surfaces)
        """mi.Scene with emitters: what all other rays meet."""
        self.table = SurfaceTable(scene, order)
        self.emitters = EmitterTable(scene, emitters, may_be_dark=sky is not None)
        self.cone = EmissionCone(scene)
        self.guide: GuideTable | None = None
        """The directions in which camera paths look for light; None: by the BRDF alone."""
        self.sky = None if sky is None else SkyTable(sky, sky_share(scene, sky))
        """The environment map; None compiles a kernel without one."""
        self.albedo = AlbedoLookup()
        self.num_surfaces = dr.opaque(mi.UInt32, len(surfaces))
        """The first triangle number that emits."""
        self.max_depth = dr.opaque(mi.UInt32, max_depth)
        self.rr_depth = dr.opaque(mi.UInt32, rr_depth)

    def to_pick_pdf(self, pdf: Any) -> Any:
        """Return a density among lamps (Float) as a density among lamps and sky."""
        return pdf if self.sky is None else pdf * self.sky.rest


def build_mitsuba_scene(scene: Scene, triangles: NDArray[np.intp], child: Any = None) -> Any:
    """Return a Mitsuba scene of one mesh, whose triangle numbers are positions in `triangles`.

    It has no integrator: `path_kernel.trace` samples its paths, as Mitsuba's `path` would.

    One kernel may trace rays into this scene and into `child`. On a GPU all rays of a
    kernel use one OptiX shader binding table, and miss whatever is in another table. A scene that
    has another scene as a child shares its table.
    """
    mesh = mi.Mesh("triangles", len(scene.vertex_positions), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["faces"] = own_integers(scene.faces[triangles])
    parameters["vertex_positions"] = own_floats(scene.vertex_positions)
    parameters.update()
    children = {"mesh": mesh} if child is None else {"mesh": mesh, "beside": child}
    return mi.load_dict({"type": "scene", **children})


@dataclass(frozen=True, kw_only=True, eq=False)
class Vertex:
    """A vertex of a path, lane by lane."""

    point: SurfacePoint
    hit: Hit
    front: Any
    """True where the ray hit the front of the triangle by its winding, Bool."""
    frame: Any
    """Shading frame, flipped with the triangle to face the incoming ray, Frame3f."""
    geometric: Any
    """Normal of the triangle on the side of the incoming ray, in the frame, Vector3f."""
    incoming: Any
    """Direction to the previous vertex, in the frame, Vector3f."""
    lobes: KernelLobes
    unmapped: Any = None
    """Normal before its map, on the side of the incoming ray, in the frame, Vector3f; None where
    the scene has no normal map."""
    turned: Any = None
    """True where `face_viewer` has turned the frame, Bool; None where it has not been asked to."""

    def evaluate(self, local: Any) -> tuple[Any, Any]:
        """Return `ggx.evaluate_bsdf` for light that comes from a direction in the frame."""
        return ggx.evaluate_bsdf(self.lobes, self.incoming, local, self.geometric, self.unmapped)

    def reverse_pdf(self, local: Any) -> Any:
        """Return `ggx.reverse_pdf`; 0 where turned: a light path is not turned to its viewer."""
        drawn = ggx.reverse_pdf(self.lobes, self.incoming, local, self.geometric)
        return drawn if self.turned is None else dr.select(self.turned, 0, drawn)


def vertex_at(
    scene: KernelScene, point: SurfacePoint, hit: Hit, direction: Any, active: Any
) -> Vertex:
    """Return the vertex, seen from the side of the triangle that the ray comes from."""
    normal, lobes = scene.table.shading(hit, active)
    geometric = dr.mulsign(point.geometric_normal, dr.dot(point.geometric_normal, normal))
    behind = dr.dot(geometric, direction) > 0
    mapped = scene.table.mapped_normal(normal, hit, active)
    shading = normal if mapped is None else mapped
    frame = mi.Frame3f(dr.select(behind, -shading, shading))
    unmapped = None
    if mapped is not None:
        unmapped = frame.to_local(dr.select(behind, -normal, normal))
    return Vertex(
        point=point,
        hit=hit,
        front=dr.dot(point.geometric_normal, direction) < 0,
        frame=frame,
        geometric=frame.to_local(dr.select(behind, -geometric, geometric)),
        incoming=frame.to_local(-direction),
        lobes=lobes,
        unmapped=unmapped,
    )


def face_viewer(
    scene: KernelScene, vertex: Vertex, active: Any, *directions: Any
) -> tuple[Vertex, tuple[Any, ...]]:
    """Return a vertex as seen from `incoming`, and other directions in its frame.

    Its lobes are scaled for that direction (`ggx.seen_from`), which its mapped normal faces.
    A mapped normal that turns away from a viewer is mirrored at the unmapped one, as by Mitsuba's
    `normalmap`: a half turn about that normal maps one frame to the other. Where the scene has no
    normal map, all stays.
    """
    if (axis := vertex.unmapped) is not None:
        turned = (vertex.incoming.z <= 0) & (dr.dot(vertex.incoming, axis) > 0)

        def turn(direction: Any) -> Any:
            return dr.select(turned, axis * (2 * dr.dot(axis, direction)) - direction, direction)

        to_world = vertex.frame.to_world
        axes = (mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
        vertex = replace(
            vertex,
            frame=mi.Frame3f(*(mi.Vector3f(to_world(turn(each))) for each in axes)),
            geometric=turn(vertex.geometric),
            incoming=turn(vertex.incoming),
            turned=turned,
        )
        directions = tuple(map(turn, directions))
    albedo = scene.albedo(vertex.incoming.z, vertex.lobes.alpha, active)
    return replace(vertex, lobes=ggx.seen_from(vertex.lobes, vertex.incoming, albedo)), directions


def hit_of(intersection: Any) -> tuple[Hit, Any]:
    """Return what rays meet by a PreliminaryIntersection3f, and whether they meet anything."""
    hit = Hit(
        distance=mi.Float(intersection.t),
        triangle=mi.UInt32(intersection.prim_index),
        barycentric=mi.Point2f(intersection.prim_uv),
    )
    return hit, intersection.is_valid()


class CameraRays:
    """The triangles of a scene that cameras see, as Mitsuba's rays meet them: a `FirstHitCaster`.

    Call after `activate`.
    """

    def __init__(self, scene: Scene) -> None:
        rows, _ = split_triangles(scene)
        self._rows = np.append(rows, MISS)
        # Mitsuba has no empty mesh: without surfaces, any triangle counts as nothing
        self._scene = build_mitsuba_scene(scene, rows if len(rows) else np.array([0]))

    def intersect(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> RayHits:
        """Return the first hits of rays [N, 3] from `origins` [N, 3], from either side."""
        start = dr.unravel(mi.Point3f, own_floats(origins))
        ray = mi.Ray3f(start, dr.unravel(mi.Vector3f, own_floats(directions)))
        hit, is_met = hit_of(self._scene.ray_intersect_preliminary(ray, coherent=True))
        position = dr.select(is_met, hit.triangle, len(self._rows) - 1)
        dr.eval(position, hit.barycentric)  # at once: read apart, each would trace all rays
        return RayHits(triangle=self._rows[read_back(position)], uv=np.array(hit.barycentric))


def off_surface(point: SurfacePoint, direction: Any) -> Any:
    """Return the start (Point3f) of a ray that leaves the surface on the side of `direction`."""
    offset = (1 + dr.max(dr.abs(point.position))) * _OFFSET
    side = dr.mulsign(mi.Float(offset), dr.dot(point.geometric_normal, direction))
    return mi.Point3f(point.position + point.geometric_normal * side)


def next_hit(
    scene: KernelScene, point: SurfacePoint, direction: Any, active: Any
) -> tuple[Hit, Any]:
    """Return `hit_of` a ray that leaves a surface in a unit direction (Vector3f)."""
    ray = mi.Ray3f(off_surface(point, direction), direction)
    return hit_of(scene.everything.ray_intersect_preliminary(ray, active=active))


def roulette(
    scene: KernelScene, throughput: Any, depth: Any, u: Any, active: Any, guided: Any = 1.0
) -> tuple[Any, Any]:
    """Return the throughput (Color3f) of paths that go on after `depth` edges, and which do.

    Args:
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


class KernelParts:
    """The sums into which a kernel puts light: direct or indirect, diffuse or specular.

    Which sums there are is decided when a kernel is traced, so that a kernel which keeps all light
    together is the one that it would be without this class. A path has its samples whatever is
    asked: the sums add up to the picture that is rendered without parts, but for roundings.
    Not a dataclass: Dr.Jit would take it for variables of the loop.
    """

    def __init__(self, *, bounces: bool, lobes: bool) -> None:
        """Choose the sums, as `storage.records.lights.part_names`."""
        self._bounces = bounces
        self._lobes = lobes
        self.count = max(1, len(part_names(bounces=bounces, lobes=lobes)))
        """Number of sums."""
        self.num_lobes = 2 if lobes else 1
        """Number of sums of light that is indirect all of it."""

    def dark(self) -> list[Any]:
        """Return sums without light (Color3f)."""
        return [mi.Color3f(0) for _ in range(self.count)]

    def first_share(self) -> Any:
        """Return the value of `carry_share` for a path that has hit no surface."""
        return mi.Color3f(0) if self._lobes else None

    def share(self, vertex: Vertex, local: Any) -> Any:
        """Return the share (Color3f) of the diffuse lobe in the light that a vertex reflects.

        It is 1 of no light, and None where lobes are not apart.

        Args:
            vertex: as the camera path sees it.
            local: Vector3f, the direction from which the light comes, in the frame.
        """
        if not self._lobes:
            return None
        reflected, _ = vertex.evaluate(local)
        diffuse = vertex.lobes.diffuse * (ggx.INV_PI * dr.maximum(local.z, 0))
        return dr.select(reflected > diffuse, diffuse / reflected, 1)

    def carry_share(self, vertex: Vertex, local: Any, depth: Any, before: Any) -> Any:
        """Return the `share` of the first vertex of a path, which has `depth` (UInt32) by now."""
        if not self._lobes:
            return None
        return dr.select(depth == 1, self.share(vertex, local), before)

    def add(self, sums: list[Any], value: Any, depth: Any, share: Any) -> list[Any]:
        """Return the sums with light (Color3f) of paths of `depth` vertices on surfaces."""
        values = self.by_lobe(value, share)
        if self._bounces:
            direct = depth == 1
            values = [
                dr.select(direct == is_direct, part, 0)
                for part in values
                for is_direct in (True, False)
            ]
        return [total + part for total, part in zip(sums, values, strict=True)]

    def by_lobe(self, value: Any, share: Any) -> list[Any]:
        """Return light (Color3f) as one, or what the diffuse and the specular lobe have of it."""
        if not self._lobes:
            return [value]
        diffuse = value * share
        return [diffuse, value - diffuse]

    def of_indirect(self, values: list[Any]) -> list[Any]:
        """Return the sums of light which is indirect all of it, from those of `by_lobe`."""
        if not self._bounces:
            return values
        return [part for value in values for part in (mi.Color3f(0), value)]
