"""A mesh or solid of a stage as triangles of its checked polygons."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.polygons import triangulate
from pipeline.foreign.usd.placed import PlacedPrim
from pipeline.foreign.usd.solids import SOLIDS, build_solid
from pipeline.foreign.usd.texture_nodes import convert_to_rec709
from storage.errors import Rejected, TrilightError


@dataclass(frozen=True, kw_only=True, eq=False)
class CutMesh:
    """The triangles of a mesh, with access to values at their corners."""

    placed: PlacedPrim
    """The mesh or solid; it receives notes on primvars whose number of values does not fit."""
    points: NDArray[np.float64]
    """[P, 3] in the units of the mesh, finite."""
    is_smooth: bool
    """True where the mesh stands for a curved surface: normals are smooth by default."""
    indices: NDArray[np.int64]
    """[sum of corners] index of the point of each polygon corner."""
    corners: NDArray[np.int64]
    """[T, 3] rows of `indices`, counter-clockwise from outside."""
    polygons: NDArray[np.int64]
    """[T] index of the polygon of each triangle."""
    num_faces: int
    """Number of triangles with those of holes, which limits count."""

    @property
    def prim(self) -> Any:
        """Return the prim of the mesh."""
        return self.placed.prim

    @cached_property
    def world_points(self) -> NDArray[np.float64]:
        """Return the points [P, 3] in meters, +Z up."""
        to_world = self.placed.to_world
        rotated: NDArray[np.float64] = np.einsum("ij,vj->vi", to_world[:3, :3], self.points)
        return rotated + to_world[:3, 3]

    def select(self, chosen: NDArray[np.bool_]) -> "CutMesh":
        """Return the triangles that a mask [T] selects."""
        return dataclasses.replace(
            self, corners=self.corners[chosen], polygons=self.polygons[chosen]
        )

    def per_corner(self, values: NDArray, interpolation: str) -> NDArray | None:
        """Return values [N, ...] at corners [T, 3, ...]; None where their number does not fit.

        Args:
            values: one for each element.
            interpolation: constant, uniform, vertex, varying or faceVarying.
        """
        where = {
            "constant": np.zeros_like(self.corners),
            "uniform": np.repeat(self.polygons[:, None], 3, axis=1),
            "vertex": self.indices[self.corners],
            "varying": self.indices[self.corners],
            "faceVarying": self.corners,
        }.get(interpolation)
        if where is None or (where.size and where.max() >= len(values)):
            return None
        return values[where]

    def read_primvar(self, name: str, time: Any) -> NDArray | None:
        """Return a primvar of the mesh, or an inherited one, at corners [T, 3, ...].

        None where there is none, or not for every corner.
        """
        from pxr import UsdGeom

        primvar = UsdGeom.PrimvarsAPI(self.prim).FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue():
            return None
        values = np.array(primvar.ComputeFlattened(time))
        spread = str(primvar.GetInterpolation())
        if values.ndim == 0 or values.dtype.kind not in "fiu":
            return None
        if str(self.prim.GetTypeName()) in SOLIDS and spread != "constant":
            return None  # the polygons of solids are generated here, so its values cannot fit
        fitting = self.per_corner(convert_to_rec709(primvar.GetAttr(), values), spread)
        if fitting is None:
            self.placed.lost.append(
                f"{self.prim.GetPath()}.{primvar.GetName()}: its number does not fit"
            )
        return fitting

    def read_coordinates(self, primvar: str, time: Any) -> NDArray[np.float64] | None:
        """Return texture coordinates [T, 3, 2], perhaps not finite; None where one is missing."""
        values = self.read_primvar(primvar, time)
        if values is None or values.ndim != 3 or values.shape[2] < 2:
            return None
        return np.asarray(values[..., :2], np.float64)

    def read_coordinate_sets(self, primvars: Sequence[str], time: Any) -> NDArray[np.float64]:
        """Return the values [T, S, 3, 2] of primvars at corners; NaN where there are none."""
        uv = np.full((len(self.corners), len(primvars), 3, 2), np.nan)
        for row, name in enumerate(primvars):
            values = self.read_coordinates(name, time)
            if values is not None:
                uv[:, row] = values
        return uv


def cut_mesh(placed: PlacedPrim, time: Any, max_faces: int | None = None) -> CutMesh:
    """Return the triangles of a mesh or solid at a time, posed by its skeleton, without its holes.

    A mirroring transform reverses the order of corners. More than `max_faces` triangles are not
    cut.

    Raises:
        Rejected: too_many_faces.
        TrilightError: its arrays contradict each other, or are not finite.
    """
    from pxr import UsdGeom

    prim = placed.prim
    holes = as_array(None, np.int64, (-1,))
    if prim.GetTypeName() in SOLIDS:
        points, counts, indices, is_smooth = build_solid(prim, time)
    else:
        mesh = UsdGeom.Mesh(prim)
        stated = mesh.GetPointsAttr().Get(time)
        points = as_array(stated, np.float64, (-1, 3))
        if placed.skin is not None and len(points):
            points = placed.skin.pose(prim, stated, time)
        counts = as_array(mesh.GetFaceVertexCountsAttr().Get(time), np.int64, (-1,))
        indices = as_array(mesh.GetFaceVertexIndicesAttr().Get(time), np.int64, (-1,))
        holes = as_array(mesh.GetHoleIndicesAttr().Get(time), np.int64, (-1,))
        is_smooth = mesh.GetSubdivisionSchemeAttr().Get() != "none"
    _check(prim, points, counts, indices)
    num_faces = int(np.maximum(counts - 2, 0).sum())
    if max_faces is not None and num_faces > max_faces:
        raise Rejected("too_many_faces", f"{num_faces} faces; expected <= {max_faces} of this mesh")
    corners, polygons = triangulate(points, counts, indices)
    is_surface = ~np.isin(polygons, holes)
    corners = corners[is_surface]
    polygons = polygons[is_surface]
    mirrored = np.linalg.det(placed.to_world[:3, :3]) < 0
    if mirrored != (UsdGeom.Gprim(prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded):
        corners = corners[:, ::-1]
    return CutMesh(
        placed=placed,
        points=points,
        is_smooth=is_smooth,
        indices=indices,
        corners=corners,
        polygons=polygons,
        num_faces=num_faces,
    )


def as_array(values: Any, dtype: type, shape: tuple[int, ...]) -> NDArray:
    """Return USD values as an array of a type and shape; raises TypeError for another kind."""
    array = np.zeros(0, dtype) if values is None else np.array(values)
    return array.astype(dtype, casting="same_kind").reshape(shape)


def _check(
    prim: Any, points: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> None:
    where = prim.GetPath()
    if (counts < 0).any() or counts.sum() != len(indices):
        raise TrilightError(
            f"{where}: faceVertexCounts add up to {counts.sum()}; expected {len(indices)}, the "
            "number of faceVertexIndices."
        )
    if len(indices) and not (0 <= indices.min() and indices.max() < len(points)):
        raise TrilightError(
            f"{where}: faceVertexIndices go from {indices.min()} to {indices.max()}; expected 0 to "
            f"{len(points) - 1}."
        )
    if not np.isfinite(points).all():
        raise TrilightError(f"{where}: points are not finite.")
