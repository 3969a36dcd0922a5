"""A mesh of a stage as polygons with its numbers checked, and as triangles."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.polygons import triangulate
from storage.errors import TrilightError


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPolygons:
    """The arrays of a mesh, which fit each other."""

    points: NDArray[np.float64]  # [P, 3] in the units of the mesh, finite
    counts: NDArray[np.int64]  # [F] corners of each polygon
    indices: NDArray[np.int64]  # [sum of counts] rows of `points`


def mesh_polygons(prim: Any, time: Any) -> MeshPolygons:
    """Return the polygons of a mesh at a time.

    Raises:
        TrilightError: its arrays contradict each other, or are not finite.
    """
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(prim)
    points = as_array(mesh.GetPointsAttr().Get(time), np.float64, (-1, 3))
    counts = as_array(mesh.GetFaceVertexCountsAttr().Get(time), np.int64, (-1,))
    indices = as_array(mesh.GetFaceVertexIndicesAttr().Get(time), np.int64, (-1,))
    _check(prim, points, counts, indices)
    return MeshPolygons(points=points, counts=counts, indices=indices)


def mesh_triangles(
    prim: Any, found: MeshPolygons, to_world: NDArray[np.float64], time: Any
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the triangles of a mesh in its place, holes left out.

    Args:
        prim: the mesh.
        found: its polygons.
        to_world: [4, 4] its place; a mirrored one turns windings round.
        time: of the holes.

    Returns:
        Corners [T, 3] as rows of `indices`, counter-clockwise from outside, and the polygon [T] of
        each.
    """
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(prim)
    corners, polygons = triangulate(found.points, found.counts, found.indices)
    holes = as_array(mesh.GetHoleIndicesAttr().Get(time), np.int64, (-1,))
    kept = ~np.isin(polygons, holes)
    corners, polygons = corners[kept], polygons[kept]
    mirrored = np.linalg.det(to_world[:3, :3]) < 0
    if mirrored != (mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded):
        corners = corners[:, ::-1]
    return corners, polygons


def moved(points: NDArray[np.float64], to_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points [P, 3] in their place."""
    placed: NDArray[np.float64] = np.einsum("ij,vj->vi", to_world[:3, :3], points)
    return placed + to_world[:3, 3]


def as_array(values: Any, dtype: type, shape: tuple[int, ...]) -> NDArray:
    """Return values of USD as an array of a kind and shape; raises TypeError for another kind."""
    found = np.zeros(0, dtype) if values is None else np.array(values)
    return found.astype(dtype, casting="same_kind").reshape(shape)


def per_corner(
    values: NDArray,
    interpolation: str,
    indices: NDArray[np.int64],
    corners: NDArray[np.int64],
    polygons: NDArray[np.int64],
) -> NDArray | None:
    """Return values at the corners [T, 3, ...] of triangles; None where their number is wrong.

    Args:
        values: [N, ...].
        interpolation: constant, uniform, vertex, varying or faceVarying.
        indices: point of each corner of the mesh.
        corners, polygons: the triangles, as `mesh_triangles` returns them.
    """
    where = {
        "constant": np.zeros_like(corners),
        "uniform": np.repeat(polygons[:, None], 3, axis=1),
        "vertex": indices[corners],
        "varying": indices[corners],
        "faceVarying": corners,
    }.get(interpolation)
    if where is None or (where.size and where.max() >= len(values)):
        return None
    return values[where]


def primvar_corners(
    prim: Any,
    name: str,
    indices: NDArray[np.int64],
    corners: NDArray[np.int64],
    polygons: NDArray[np.int64],
    time: Any,
) -> NDArray | None:
    """Return a primvar of a mesh, or of what is above it, at the corners of triangles.

    None where it has none, or not for every corner; arguments as of `per_corner`.
    """
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    values = np.array(primvar.ComputeFlattened(time))
    if values.ndim == 0 or values.dtype.kind not in "fiu":
        return None
    return per_corner(values, str(primvar.GetInterpolation()), indices, corners, polygons)


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
