"""Quality checks of a level, whichever method made it. Cheap checks come first."""

import igl
import numpy as np

from pipeline.assets.cleaning.clean import clean
from pipeline.assets.quality.measure import MeasuredSource, half_edges, open_half_edges
from pipeline.assets.settings import GateSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from storage.records.asset import LevelQuality


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
    if not low <= source.area_ratio(mesh) <= high:
        raise Rejected(
            "area_changed",
            f"{source.area_ratio(mesh):.2f} times the source's area at {budget} faces; "
            f"expected {low} to {high}",
        )
    deviation = source.surface.hausdorff_deviation(mesh)
    error = deviation.two_way(99)
    if error > max_error_p99:
        raise Rejected(
            "error_over_bound",
            f"p99 distance {error:.2%} at {budget} faces; expected <= {max_error_p99:.2%}",
        )
    quality = source.quality(mesh, deviation)
    _check_shape(quality, budget, gate)
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


def _check_shape(quality: LevelQuality, budget: int, gate: GateSettings) -> None:
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


def require_watertight(mesh: TriangleMesh) -> None:
    """Raise Rejected `not_watertight` where a clean mesh is not closed, oriented and manifold."""
    edges = half_edges(mesh)
    num_open = len(open_half_edges(mesh))
    num_shared = len(edges) - len(np.unique(edges, axis=0))
    num_joints = int((~igl.is_vertex_manifold(mesh.faces)).sum()) if len(edges) else 0
    if num_open or num_shared or num_joints:
        raise Rejected(
            "not_watertight",
            f"{num_open} edges without a second triangle, {num_shared} with triangles of equal "
            f"direction, {num_joints} vertices where surfaces touch; expected 0 of each",
        )
