"""A mesh or solid of a stage as checked polygons, and as triangles."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.polygons import triangulate
from pipeline.foreign.usd.placed import PlacedPrim
from pipeline.foreign.usd.solids import SOLIDS, build_solid
from pipeline.foreign.usd.texture_nodes import convert_to_rec709
from storage.errors import TrilightError


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPolygons:
    """The arrays of a mesh, checked to be consistent."""

    placed: PlacedPrim
    points: NDArray[np.float64]  # [P, 3] in the units of the mesh, finite
    counts: NDArray[np.int64]  # [F] corners of each polygon
    indices: NDArray[np.int64]  # [sum of counts] rows of `points`
    holes: NDArray[np.int64]  # [H] indices of polygons that are holes
    is_smooth: bool  # the mesh stands for a curved surface: normals are smooth by default


@dataclass(frozen=True, kw_only=True, eq=False)
class CutMesh:
    """The triangles of a mesh, with access to values at their corners."""

    prim: Any
    indices: NDArray[np.int64]
    """[sum of corners] index of the point of each polygon corner."""
    corners: NDArray[np.int64]
    """[T, 3] rows of `indices`, counter-clockwise from outside."""
    polygons: NDArray[np.int64]
    """[T] index of the polygon of each triangle."""
    lost: list[str]
    """Receives notes on primvars whose number of values does not fit."""

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
            self.lost.append(f"{self.prim.GetPath()}.{primvar.GetName()}: its number does not fit")
        return fitting

    def read_coordinates(self, primvar: str, time: Any) -> NDArray[np.float64] | None:
        """Return texture coordinates [T, 3, 2], perhaps not finite; None where one is missing."""
        values = self.read_primvar(primvar, time)
        if values is None or values.ndim != 3 or values.shape[2] < 2:
            return None
        return np.asarray(values[..., :2], np.float64)


def mesh_polygons(placed: PlacedPrim, time: Any) -> MeshPolygons:
    """Return the polygons of a mesh or solid at a time, posed by its skeleton if it has one.

    Raises:
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
    return MeshPolygons(
        placed=placed,
        points=points,
        counts=counts,
        indices=indices,
        holes=holes,
        is_smooth=is_smooth,
    )


def cut_mesh(mesh: MeshPolygons) -> CutMesh:
    """Return the triangles of a placed mesh without its holes.

    A mirroring transform reverses the order of corners.
    """
    from pxr import UsdGeom

    prim = mesh.placed.prim
    to_world = mesh.placed.to_world
    corners, polygons = triangulate(mesh.points, mesh.counts, mesh.indices)
    is_surface = ~np.isin(polygons, mesh.holes)
    corners = corners[is_surface]
    polygons = polygons[is_surface]
    mirrored = np.linalg.det(to_world[:3, :3]) < 0
    if mirrored != (UsdGeom.Gprim(prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded):
        corners = corners[:, ::-1]
    return CutMesh(
        prim=prim,
        indices=mesh.indices,
        corners=corners,
        polygons=polygons,
        lost=mesh.placed.lost,
    )


def place_points(points: NDArray[np.float64], to_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points [P, 3] transformed by a matrix [4, 4]."""
    rotated: NDArray[np.float64] = np.einsum("ij,vj->vi", to_world[:3, :3], points)
    return rotated + to_world[:3, 3]


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
