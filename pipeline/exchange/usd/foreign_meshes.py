"""Reads a USD mesh as world-space triangles, with its normals or those of its faces."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.part import drop_empty, unit_normals
from pipeline.foreign.usd.placed import PlacedPrim
from pipeline.foreign.usd.polygons import (
    CutMesh,
    MeshPolygons,
    as_array,
    cut_mesh,
    mesh_polygons,
    place_points,
)
from pipeline.scenes.shading import smooth_shaded

SMOOTH_ANGLE_DEG = 30.0
"""Maximum angle of a smooth edge where a subdivision surface states no normals."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleSoup:
    """Triangles with three separate corners each."""

    positions: NDArray[np.float32]  # [T, 3, 3] world
    normals: NDArray[np.float32]  # [T, 3, 3] unit
    cut: CutMesh  # corners of the mesh, for values at them


def read_mesh(placed: PlacedPrim, time: Any, lost: list[str]) -> TriangleSoup:
    """Return the triangles of a mesh that have an area.

    Raises:
        TrilightError: the arrays of the mesh contradict each other, or are not finite.
    """
    polygons = mesh_polygons(placed, time)
    cut = cut_mesh(polygons)
    rows = cut.indices[cut.corners]
    corners = place_points(polygons.points, placed.to_world)[rows]
    positions, flat, has_area = drop_empty(corners)
    if not has_area.all():
        lost.append(f"{cut.prim.GetPath()}: {int((~has_area).sum())} triangles without an area")
    cut = cut.select(has_area)
    normals = _normals(polygons, cut, time, positions, flat, lost)
    return TriangleSoup(positions=positions, normals=normals, cut=cut)


def _normals(
    polygons: MeshPolygons,
    cut: CutMesh,
    time: Any,
    positions: NDArray[np.float32],
    flat: NDArray[np.float64],
    lost: list[str],
) -> NDArray[np.float32]:
    placed = polygons.placed
    where = cut.prim.GetPath()
    stated = None if placed.skin is not None else _stated_normals(cut.prim, time)
    if stated is None:
        if not (polygons.is_smooth or placed.skin is not None) or not len(positions):
            return unit_normals(None, flat)
        if placed.skin is not None:
            lost.append(f"{where}: posed by bones; its normals are those of its faces")
        elif cut.prim.GetTypeName() == "Mesh":
            lost.append(f"{where}: subdivision; its cage was read, with smooth normals")
        return _smooth(positions, cut)
    normals = cut.per_corner(*stated)
    if normals is None:
        lost.append(f"{where}: the number of normals does not match")
        return unit_normals(None, flat)
    normal_matrix = np.linalg.inv(placed.to_world[:3, :3]).T
    return unit_normals(np.einsum("ij,tcj->tci", normal_matrix, normals), flat)


def _smooth(positions: NDArray[np.float32], cut: CutMesh) -> NDArray[np.float32]:
    points = cut.indices[cut.corners]
    _, first, inverse = np.unique(points, return_index=True, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.uint32)
    shaded = smooth_shaded(positions.reshape(-1, 3)[first], faces, SMOOTH_ANGLE_DEG)
    return shaded.normals[shaded.faces]


def _stated_normals(prim: Any, time: Any) -> tuple[NDArray[np.float64], str] | None:
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh(prim)
    if not mesh:
        return None
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        values = primvar.ComputeFlattened(time)
        interpolation = str(primvar.GetInterpolation())
    else:
        values = mesh.GetNormalsAttr().Get(time)
        interpolation = str(mesh.GetNormalsInterpolation())
    if values is None or len(values) == 0:
        return None
    return as_array(values, np.float64, (-1, 3)), interpolation
