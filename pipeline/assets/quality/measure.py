"""Measures of a level, all taken against the cleaned source, and its quality checks.

Distances are two-way (Hausdorff), by evenly spread points and exact distances. The quality check
uses the 99th percentile: one vertex decides the largest value, and a mean accepts almost anything.
Components are measured apart: those with less than one percent of the area escape it. The checks
are those of every decimation method; cheap ones come first.
"""

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from trimesh.geometry import faces_to_edges

from pipeline.assets.cleaning.clean import clean
from pipeline.assets.cleaning.orient import first_faces, outside_rays
from pipeline.assets.settings import GateSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from storage.records.asset import Level, LevelQuality
from storage.seeds import rng_for

_NUM_POINTS = 8192
"""Points per direction: the measured 99th percentile lies between 98.7 and 99.3 (3 sigma)."""

_OWN_SIZE = 0.25
"""A component is lost where most of its points are farther from the result than this fraction of
its size."""

_VISIBLE = 0.005
"""Distance that never counts as lost, as a fraction of the object's diagonal: a pixel or two."""

_DIRECTIONS = 8
_RAYS_PER_SIDE = 64
"""The ray spacing is 2.8 % of the box: one ray in forty hits the outline of a large object."""


def level_mesh(level: Level) -> TriangleMesh:
    """Return the mesh of a level in double precision."""
    return TriangleMesh(
        positions=level.positions.astype(np.float64), faces=level.faces.astype(np.int64)
    )


def unit_normals(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Return the unit normal [F, 3] of each face; each must have an area."""
    vectors = mesh.double_area_vectors
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def round_digits(value: float) -> float:
    """Round a measure to six digits: more than it has, and short in a file."""
    return float(f"{value:.6g}")


def area_variation(mesh: TriangleMesh) -> float:
    """Return the standard deviation of the areas over their mean; 0 where all are equal."""
    areas = mesh.areas
    return float(areas.std() / areas.mean())


def smallest_angles_deg(mesh: TriangleMesh) -> NDArray[np.float64]:
    """Return the smallest angle [F] of each face; 60 where it is equilateral."""
    edges = np.roll(mesh.corners, -1, axis=1) - mesh.corners
    lengths = np.sort(np.linalg.norm(edges, axis=2), axis=1)
    a, b, c = lengths.T  # the smallest angle lies opposite the shortest side
    cosine = (b * b + c * c - a * a) / (2 * b * c)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def faces_of_edges(mesh: TriangleMesh) -> NDArray[np.int64]:
    """Return the number [E] of faces that share each edge: 1 at the border of an open surface."""
    ends = np.sort(faces_to_edges(mesh.faces), axis=1)
    return np.unique(ends[:, 0] * len(mesh.positions) + ends[:, 1], return_counts=True)[1]


def open_half_edges(mesh: TriangleMesh) -> NDArray[np.int64]:
    """Return the edges [E, 2] that no face has in the opposite direction."""
    edges = faces_to_edges(mesh.faces)
    count = len(mesh.positions)
    opposite = edges[:, 1] * count + edges[:, 0]
    return edges[~np.isin(edges[:, 0] * count + edges[:, 1], opposite)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Deviation:
    """Distances and angles between two surfaces, point by point."""

    to_other: NDArray[np.float64]
    """[N] distances from points of the first surface to the second, as fractions of the diagonal of
    the first one's bounding box."""
    from_other: NDArray[np.float64]
    """[N] distances from points of the second surface to the first, in the same unit."""
    angle_deg: NDArray[np.float64]
    """[N] angles between the normal at each point of the first surface and at the nearest point of
    the second; 0 to 90, because the nearest point of a thin wall may lie on its other side."""

    def two_way(self, percentile: float) -> float:
        """Return the larger of the two directions' percentiles."""
        both = (self.to_other, self.from_other)
        return max(float(np.percentile(distances, percentile)) for distances in both)


def sample_surface(
    mesh: TriangleMesh, uniform: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return N points [N, 3] spread evenly by area, and their faces [N].

    There is one in each of N equal fractions of the area.

    Args:
        mesh: at least one face with area.
        uniform: [N, 3] independent numbers in [0, 1).
    """
    total = np.cumsum(mesh.areas)
    target = (np.arange(len(uniform)) + uniform[:, 0]) / len(uniform) * total[-1]
    face = np.minimum(np.searchsorted(total, target, side="right"), len(total) - 1)
    root = np.sqrt(uniform[:, 1])
    weights = np.stack([1 - root, root * (1 - uniform[:, 2]), root * uniform[:, 2]], axis=1)
    return np.einsum("ij,ijk->ik", weights, mesh.corners[face]), face


class Surface:
    """The reference surface of comparisons, with its points and search tree."""

    def __init__(self, mesh: TriangleMesh, uniform: NDArray[np.float64]) -> None:
        """Sample `mesh`, and later each other surface, at `uniform` [N, 3]."""
        self.mesh = mesh
        self._points, self.point_faces = sample_surface(mesh, uniform)
        self._uniform = uniform
        self.normals = unit_normals(mesh)
        """[F, 3] unit normal of each face."""
        self._tree = igl.AABB()
        self._tree.init(mesh.positions, mesh.faces)

    def find_nearest(self, points: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return squared distance [N], face [N] and nearest point [N, 3] of points [N, 3]."""
        squared, faces, nearest = self._tree.squared_distance(
            self.mesh.positions, self.mesh.faces, points
        )
        return np.ravel(squared), np.ravel(faces).astype(np.int64), np.asarray(nearest)

    def hausdorff_deviation(self, other: TriangleMesh) -> Deviation:
        """Return the sampled Hausdorff distances to and from `other`, point by point."""
        points = self._points
        squared, nearest, _ = igl.point_mesh_squared_distance(points, other.positions, other.faces)
        cosine = np.einsum("ij,ij->i", self.normals[self.point_faces], unit_normals(other)[nearest])
        back, _, _ = self.find_nearest(sample_surface(other, self._uniform)[0])
        return Deviation(
            to_other=np.sqrt(squared) / self.mesh.diagonal,
            from_other=np.sqrt(back) / self.mesh.diagonal,
            angle_deg=np.degrees(np.arccos(np.minimum(np.abs(cosine), 1.0))),
        )


class MeasuredSource:
    """A cleaned source with the reference values of its levels' measures."""

    def __init__(self, mesh: TriangleMesh) -> None:
        """Sample a clean mesh of the unit box."""
        self.mesh = mesh
        self.surface = Surface(mesh, rng_for(0, "asset-error").random((_NUM_POINTS, 3)))
        component = np.asarray(igl.facet_components(mesh.faces)[1], np.int64)  # over edges
        self._component = component[self.surface.point_faces]
        self.num_components = int(component.max()) + 1
        order = np.argsort(component, kind="stable")
        starts = np.searchsorted(component[order], np.arange(self.num_components))
        low = np.minimum.reduceat(mesh.corners[order].min(axis=1), starts, axis=0)
        high = np.maximum.reduceat(mesh.corners[order].max(axis=1), starts, axis=0)
        extents = np.linalg.norm(high - low, axis=1) / mesh.diagonal
        self._lost_beyond = np.maximum(_OWN_SIZE * extents, _VISIBLE)[self._component]
        self._silhouette = silhouette(mesh)
        self._area = float(mesh.areas.sum())

    def area_ratio(self, result: TriangleMesh) -> float:
        """Return the area of `result` as a multiple of the source's."""
        return float(result.areas.sum()) / self._area

    def _lost_area(self, distances: NDArray[np.float64]) -> float:
        """Return the fraction of the source's area in lost components.

        Args:
            distances: [N] from each sample point to the result, as a fraction of the diagonal.

        A component without a sample point (below about 1/8000 of the area) never counts as lost.
        """
        count = self.num_components
        is_far = distances > self._lost_beyond
        far = np.bincount(self._component, weights=is_far, minlength=count)
        points = np.bincount(self._component, minlength=count)
        return float(points[2 * far > points].sum() / points.sum())

    def source_quality(self) -> LevelQuality:
        """Return the measures of the unchanged source as a level: the error is exactly 0."""
        none = np.zeros(len(self.surface.point_faces))
        return self.quality(self.mesh, Deviation(to_other=none, from_other=none, angle_deg=none))

    def quality(self, result: TriangleMesh, deviation: Deviation | None = None) -> LevelQuality:
        """Return all measures of a clean result; a known `deviation` saves its computation."""
        measured = deviation or self.surface.hausdorff_deviation(result)
        iou = intersection_over_union(self._silhouette, silhouette(result))
        return LevelQuality(
            error_mean=round_digits(max(measured.to_other.mean(), measured.from_other.mean())),
            error_p99=round_digits(measured.two_way(99)),
            error_max=round_digits(measured.two_way(100)),
            normal_error_deg=round_digits(measured.angle_deg.mean()),
            area_ratio=round_digits(self.area_ratio(result)),
            silhouette_iou=round_digits(iou),
            lost_area=round_digits(self._lost_area(measured.to_other)),
            area_variation=round_digits(area_variation(result)),
            min_angle_p5_deg=round_digits(np.percentile(smallest_angles_deg(result), 5)),
            open_edges=int((faces_of_edges(result) == 1).sum()),
        )


def silhouette(mesh: TriangleMesh) -> NDArray[np.bool_]:
    """Return True for each ray of a fixed set around the unit box that hits the mesh."""
    return first_faces(mesh, *outside_rays(_DIRECTIONS, _RAYS_PER_SIDE)) >= 0


def intersection_over_union(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Return the number of rays that hit both over the number that hit either."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 1.0


def check_level(
    result: TriangleMesh,
    source: MeasuredSource,
    budget: int,
    gate: GateSettings,
    max_error_p99: float,
) -> tuple[TriangleMesh, LevelQuality]:
    """Return the cleaned result of a decimation with its measures.

    Args:
        result: the unchecked result.
        source: the cleaned source.
        budget: most faces; `gate` has the other limits.
        max_error_p99: limit on the error, at most that of `gate`.

    Raises:
        Rejected: budget_missed, nonfinite_result, bbox_escaped, area_changed, error_over_bound,
            normals_changed, silhouette_changed, parts_lost.
    """
    _check_vertices(result, source.mesh, gate.max_outside)
    mesh = clean(result)
    if not 1 <= len(mesh.faces) <= budget:
        raise Rejected("budget_missed", f"{len(mesh.faces)} faces; expected 1 to {budget}")
    low, high = gate.area_ratio
    ratio = source.area_ratio(mesh)
    if not low <= ratio <= high:
        message = f"{ratio:.2f} times the source's area at {budget} faces; expected {low} to {high}"
        raise Rejected("area_changed", message)
    deviation = source.surface.hausdorff_deviation(mesh)
    error = deviation.two_way(99)
    if error > max_error_p99:
        raise Rejected(
            "error_over_bound",
            f"p99 distance {error:.2%} at {budget} faces; expected <= {max_error_p99:.2%}",
        )
    quality = source.quality(mesh, deviation)
    if quality.normal_error_deg > gate.max_normal_error_deg:
        raise Rejected(
            "normals_changed",
            f"normals are off by {quality.normal_error_deg:.0f} degrees on average at {budget} "
            f"faces; expected <= {gate.max_normal_error_deg:.0f}",
        )
    if quality.silhouette_iou < gate.min_silhouette_iou:
        raise Rejected(
            "silhouette_changed",
            f"outlines agree by {quality.silhouette_iou:.1%} at {budget} faces; "
            f"expected >= {gate.min_silhouette_iou:.0%}",
        )
    if quality.lost_area > gate.max_lost_area:
        raise Rejected(
            "parts_lost",
            f"parts with {quality.lost_area:.1%} of the area are gone at {budget} faces; "
            f"expected <= {gate.max_lost_area:.1%}",
        )
    return mesh, quality


def _check_vertices(result: TriangleMesh, source: TriangleMesh, max_outside: float) -> None:
    used = result.positions[np.unique(result.faces)]
    if len(used) == 0:
        raise Rejected("budget_missed", "no face is left")
    if not np.isfinite(used).all():
        raise Rejected("nonfinite_result", "a vertex of the result is not finite")
    low = source.positions.min(axis=0)
    high = source.positions.max(axis=0)
    outside = float(np.maximum(low - used, used - high).max()) / source.diagonal
    if outside > max_outside:
        raise Rejected("bbox_escaped", f"a vertex is {outside:.2%} of the diagonal outside the box")


def require_watertight(mesh: TriangleMesh) -> None:
    """Raise Rejected `not_watertight` where a clean mesh is not closed, oriented and manifold."""
    edges = faces_to_edges(mesh.faces)
    num_open = len(open_half_edges(mesh))
    num_shared = len(edges) - len(np.unique(edges, axis=0))
    num_joints = int((~igl.is_vertex_manifold(mesh.faces)).sum()) if len(edges) else 0
    if num_open or num_shared or num_joints:
        raise Rejected(
            "not_watertight",
            f"{num_open} edges without a second triangle, {num_shared} with triangles of equal "
            f"direction, {num_joints} vertices where surfaces touch; expected 0 of each",
        )
