"""A USD mesh as triangles in our world, with the normals that it states or that its faces have."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.usd.placed import Placed
from pipeline.foreign.usd.polygons import as_array, mesh_polygons, mesh_triangles, moved, per_corner
from pipeline.scenes.shading import smooth_shaded

SMOOTH_ANGLE_DEG = 30.0
"""Edges up to this angle are smooth where a subdivision surface states no normals."""

_SMALLEST_DOUBLE_AREA = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleSoup:
    """Triangles with three corners of their own each."""

    positions: NDArray[np.float32]  # [T, 3, 3] world
    normals: NDArray[np.float32]  # [T, 3, 3] unit
    corners: NDArray[np.int64]
    """[T, 3] which corner of the mesh each was: where values per corner are found."""
    polygons: NDArray[np.int64]  # [T] which polygon of the mesh


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshToShade:
    """A mesh whose triangles get materials."""

    prim: Any  # the mesh
    soup: TriangleSoup  # its triangles
    indices: NDArray[np.int64]  # point of each of its corners


def read_mesh(placed: Placed, time: Any, lost: list[str]) -> TriangleSoup:
    """Return the triangles of a mesh that have an area.

    Raises:
        TrilightError: its arrays contradict each other, or are not finite.
    """
    from pxr import UsdGeom

    prim = placed.prim
    mesh, found = UsdGeom.Mesh(prim), mesh_polygons(placed, time)
    corners, polygons = mesh_triangles(prim, found, placed.to_world, time)
    indices = found.indices
    positions = moved(found.points, placed.to_world)[indices[corners]].astype(np.float32)
    cross = _cross(positions)
    solid = np.sqrt(np.square(cross).sum(axis=1)) > _SMALLEST_DOUBLE_AREA
    if not solid.all():
        lost.append(f"{prim.GetPath()}: {int((~solid).sum())} triangles without an area")
    corners, polygons, positions = corners[solid], polygons[solid], positions[solid]
    normals = _normals(placed, mesh, time, indices, corners, polygons, positions, lost)
    return TriangleSoup(positions=positions, normals=normals, corners=corners, polygons=polygons)


def _normals(
    placed: Placed,
    mesh: Any,
    time: Any,
    indices: NDArray[np.int64],
    corners: NDArray[np.int64],
    polygons: NDArray[np.int64],
    positions: NDArray[np.float32],
    lost: list[str],
) -> NDArray[np.float32]:
    cross = _cross(positions)
    flat = cross / np.linalg.norm(cross, axis=1, keepdims=True)
    stated = _stated_normals(mesh, time)
    if placed.skin is not None and len(positions):
        lost.append(f"{placed.prim.GetPath()}: posed by bones; its normals are those of its faces")
        return _smooth(positions, indices, corners)
    if stated is None:
        if mesh.GetSubdivisionSchemeAttr().Get() == "none" or not len(positions):
            return np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
        lost.append(f"{placed.prim.GetPath()}: subdivision; its cage was read, with smooth normals")
        return _smooth(positions, indices, corners)
    found = per_corner(*stated, indices, corners, polygons)
    if found is None:
        lost.append(f"{placed.prim.GetPath()}: normals whose number does not fit")
        return np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
    turn = np.linalg.inv(placed.to_world[:3, :3]).T
    turned = np.einsum("ij,tcj->tci", turn, found)
    length = np.linalg.norm(turned, axis=2, keepdims=True)
    usable = np.isfinite(length) & (length > 0)
    unit = np.where(usable, turned / np.where(usable, length, 1), flat[:, None])
    return np.asarray(unit, np.float32)


def _smooth(
    positions: NDArray[np.float32], indices: NDArray[np.int64], corners: NDArray[np.int64]
) -> NDArray[np.float32]:
    _, first, inverse = np.unique(indices[corners], return_index=True, return_inverse=True)
    faces = inverse.reshape(-1, 3).astype(np.uint32)
    shaded = smooth_shaded(positions.reshape(-1, 3)[first], faces, SMOOTH_ANGLE_DEG)
    return shaded.normals[shaded.faces]


def _stated_normals(mesh: Any, time: Any) -> tuple[NDArray[np.float64], str] | None:
    from pxr import UsdGeom

    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        values, interpolation = primvar.ComputeFlattened(time), str(primvar.GetInterpolation())
    else:
        values, interpolation = mesh.GetNormalsAttr().Get(time), str(mesh.GetNormalsInterpolation())
    if values is None or len(values) == 0:
        return None
    return as_array(values, np.float64, (-1, 3)), interpolation


def _cross(positions: NDArray[np.float32]) -> NDArray[np.float64]:
    wide = positions.astype(np.float64)
    return np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
