"""`UsdSource`: the triangles and materials of a USD object; only child processes make one."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.limits import ReadLimits
from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.usd.object_stage import UsdStage, open_stage, read_or_reject
from pipeline.foreign.usd.polygons import CutMesh, cut_mesh, mesh_polygons, place_points
from pipeline.foreign.usd.stage_materials import StageMaterials, read_stage_materials
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


def _require_precision(meshes: Sequence[PlacedMesh], farthest: float) -> None:
    used = np.concatenate([p.points[p.cut.indices[p.cut.corners.ravel()]] for p in meshes])
    extent = float(np.ptp(used, axis=0).max())
    if farthest > _MAX_OFFSET * extent > 0:
        raise Rejected(
            "offset_precision",
            f"points lie {farthest / extent:.3g} times the size of the object from their origin",
        )


class UsdSource:
    """The contents of a USD file; materials are read where limits include them."""

    def __init__(self, path: Path, limits: ReadLimits) -> None:
        """Open the file and those that it names.

        Raises:
            Rejected: as `open_stage`, or too_large_bytes for all layers together.
        """
        self._path = path
        self._limits = limits
        self.stage: UsdStage = open_stage(path, limits)
        self._digest, bytes_left = _digest_files(self.stage.opened.files, limits.max_bytes)
        self._materials: StageMaterials | Rejected | None = None
        if limits.with_materials:
            try:
                self._materials = read_or_reject(
                    path,
                    lambda: read_stage_materials(
                        self.stage, bytes_left, normals=limits.with_normal_maps
                    ),
                )
            except Rejected as why:
                self._materials = Rejected(why.reason, why.message)  # its traceback holds the stage

    @property
    def sha256(self) -> str:
        """Return the digest of all layers, the root first, and of the pictures of materials."""
        digest = self._digest.copy()
        if isinstance(self._materials, StageMaterials):
            pictures = self._materials.pictures.data
            for place in sorted(pictures):
                digest.update(pictures[place])
        return digest.hexdigest()

    @property
    def unread(self) -> tuple[str, ...]:
        """Return sentences on contents of the file that are not read, each once."""
        return self.stage.opened.notes

    @cached_property
    def meshes(self) -> tuple[PlacedMesh, ...]:
        """Return the meshes; raises Rejected as `place_meshes`, or load_error."""
        return read_or_reject(self._path, lambda: place_meshes(self.stage, self._limits))

    @cached_property
    def mesh(self) -> TriangleMesh:
        """Return all meshes as one, unwelded, in meters, +Z up; raises Rejected as `meshes`."""
        starts = np.cumsum([0, *(len(part.points) for part in self.meshes)])
        faces = [
            part.cut.indices[part.cut.corners] + start
            for part, start in zip(self.meshes, starts[:-1], strict=True)
        ]
        positions = np.concatenate([part.points for part in self.meshes])
        return TriangleMesh(positions=positions, faces=np.concatenate(faces))

    def materials(self) -> StageMaterials:
        """Return the materials; raises Rejected as `read_stage_materials`, or no_materials."""
        if isinstance(self._materials, Rejected):
            raise self._materials
        if self._materials is None:
            raise Rejected("no_materials", "materials were not asked for")
        return self._materials


def _digest_files(files: Sequence[Path], bytes_left: int) -> "tuple[hashlib._Hash, int]":
    """Return the digest of files, and the bytes that are left of their bound."""
    digest = hashlib.sha256()
    for path in files:
        data = path.read_bytes()
        if len(data) > bytes_left:
            raise Rejected("too_large_bytes", f"the layers together; {bytes_left} bytes are left")
        digest.update(data)
        bytes_left -= len(data)
    return digest, bytes_left
