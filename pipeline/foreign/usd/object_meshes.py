"""All meshes of a USD stage as one, in meters with +Z up, with their texture coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.usd.object_stage import UsdStage
from pipeline.foreign.usd.polygons import CutMesh, cut_mesh, mesh_polygons, place_points
from storage.errors import Rejected

_MAX_OFFSET = 1e5
"""Maximum distance of points from their mesh's origin, in sizes of the object: points are float32,
and off by 1 % of the size beyond it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedMesh:
    """The triangles of one mesh of a stage in world space."""

    number: int
    """Index of the mesh within the stage."""
    points: NDArray[np.float64]
    """[P, 3] in meters, +Z up."""
    cut: CutMesh
    """Triangles as rows of `points`."""

    def coordinates(self, primvars: Sequence[str], time: object) -> NDArray[np.float64]:
        """Return the values [T, S, 3, 2] of primvars at corners; NaN where there are none."""
        uv = np.full((len(self.cut.corners), len(primvars), 3, 2), np.nan)
        for row, name in enumerate(primvars):
            values = self.cut.read_coordinates(name, time)
            if values is not None:
                uv[:, row] = values
        return uv


def place_meshes(stage: UsdStage, limits: ReadLimits) -> tuple[PlacedMesh, ...]:
    """Return the meshes of a stage that have triangles.

    Raises:
        Rejected: no_faces, too_many_faces, offset_precision.
        TrilightError: arrays of a mesh contradict each other, or are not finite.
    """
    meshes: list[PlacedMesh] = []
    faces_left = limits.max_faces
    farthest = 0.0
    for number, each in enumerate(stage.meshes):
        polygons = mesh_polygons(each, stage.time)
        faces_left -= int(np.maximum(polygons.counts - 2, 0).sum())
        if faces_left < 0:
            raise Rejected("too_many_faces", f"expected <= {limits.max_faces} faces")
        cut = cut_mesh(polygons)
        if len(cut.corners):
            scale = np.linalg.norm(each.to_world[:3, :3], 2)
            farthest = max(farthest, float(scale * np.abs(polygons.points).max()))
            points = place_points(polygons.points, each.to_world)
            meshes.append(PlacedMesh(number=number, points=points, cut=cut))
    if not meshes:
        raise Rejected("no_faces", "the stage shows no mesh with triangles")
    _require_precision(meshes, farthest)
    return tuple(meshes)


def join_meshes(meshes: Sequence[PlacedMesh]) -> TriangleMesh:
    """Return all parts as one mesh, unwelded."""
    starts = np.cumsum([0, *(len(part.points) for part in meshes)])
    faces = [p.cut.indices[p.cut.corners] + k for p, k in zip(meshes, starts[:-1], strict=True)]
    return TriangleMesh(
        positions=np.concatenate([part.points for part in meshes]), faces=np.concatenate(faces)
    )


def _require_precision(meshes: Sequence[PlacedMesh], farthest: float) -> None:
    used = np.concatenate([p.points[p.cut.indices[p.cut.corners.ravel()]] for p in meshes])
    extent = float(np.ptp(used, axis=0).max())
    if farthest > _MAX_OFFSET * extent > 0:
        raise Rejected(
            "offset_precision",
            f"points lie {farthest / extent:.3g} times the size of the object from their origin",
        )
