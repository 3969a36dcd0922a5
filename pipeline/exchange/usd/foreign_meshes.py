"""A USD mesh as triangles in our world, with the normals that it states or that its faces have.

Polygons become triangles: fans where they are convex, cut-off ears where they are not.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.usd.foreign_placed import Placed
from pipeline.scenes.shading import smooth_shaded
from storage.errors import TrilightError

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
    mesh = UsdGeom.Mesh(prim)
    points = _array(mesh.GetPointsAttr().Get(time), np.float64, (-1, 3))
    counts = _array(mesh.GetFaceVertexCountsAttr().Get(time), np.int64, (-1,))
    indices = _array(mesh.GetFaceVertexIndicesAttr().Get(time), np.int64, (-1,))
    _check(prim, points, counts, indices)
    corners, polygons = triangulated(points, counts, indices)
    holes = _array(mesh.GetHoleIndicesAttr().Get(time), np.int64, (-1,))
    kept = ~np.isin(polygons, holes)
    corners, polygons = corners[kept], polygons[kept]
    world = np.einsum("ij,vj->vi", placed.to_world[:3, :3], points) + placed.to_world[:3, 3]
    mirrored = np.linalg.det(placed.to_world[:3, :3]) < 0
    if mirrored != (mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded):
        corners = corners[:, ::-1]
    positions = world[indices[corners]].astype(np.float32)
    cross = _cross(positions)
    solid = np.sqrt(np.square(cross).sum(axis=1)) > _SMALLEST_DOUBLE_AREA
    if not solid.all():
        lost.append(f"{prim.GetPath()}: {int((~solid).sum())} triangles without an area")
    corners, polygons, positions = corners[solid], polygons[solid], positions[solid]
    normals = _normals(placed, mesh, time, indices, corners, polygons, positions, lost)
    return TriangleSoup(positions=positions, normals=normals, corners=corners, polygons=polygons)


def per_corner(
    values: NDArray, interpolation: str, indices: NDArray[np.int64], soup: TriangleSoup
) -> NDArray | None:
    """Return values at the corners [T, 3, ...] of triangles; None where their number is wrong.

    Args:
        values: [N, ...].
        interpolation: constant, uniform, vertex, varying or faceVarying.
        indices: point of each corner of the mesh.
        soup: the triangles.
    """
    where = {
        "constant": np.zeros_like(soup.corners),
        "uniform": np.repeat(soup.polygons[:, None], 3, axis=1),
        "vertex": indices[soup.corners],
        "varying": indices[soup.corners],
        "faceVarying": soup.corners,
    }.get(interpolation)
    if where is None or (where.size and where.max() >= len(values)):
        return None
    return values[where]


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
    if stated is None:
        if mesh.GetSubdivisionSchemeAttr().Get() == "none" or not len(positions):
            return np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
        lost.append(f"{placed.prim.GetPath()}: subdivision; its cage was read, with smooth normals")
        return _smooth(positions, indices, corners)
    soup = TriangleSoup(positions=positions, normals=positions, corners=corners, polygons=polygons)
    found = per_corner(*stated, indices, soup)
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
    return _array(values, np.float64, (-1, 3)), interpolation


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


def _cross(positions: NDArray[np.float32]) -> NDArray[np.float64]:
    wide = positions.astype(np.float64)
    return np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])


def _array(values: Any, dtype: type, shape: tuple[int, ...]) -> NDArray:
    found = np.zeros(0, dtype) if values is None else np.array(values)
    return found.astype(dtype, casting="same_kind").reshape(shape)


MAX_EAR_CORNERS = 2000
"""Maximum corners of a polygon that is not convex; larger polygons are cut as fans."""


def triangulated(
    points: NDArray[np.float64], counts: NDArray[np.int64], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the triangles of polygons.

    Args:
        points: [P, 3].
        counts: [F] corners of each polygon.
        indices: [sum of counts] rows of `points`.

    Returns:
        Corners [T, 3], as positions within `indices`, and the polygon [T] of each. Polygons of
        fewer than three corners give none.
    """
    starts = np.cumsum(counts) - counts
    corners: list[NDArray[np.int64]] = []
    owners: list[NDArray[np.int64]] = []
    for count in np.unique(counts[counts >= 3]):
        faces = np.flatnonzero(counts == count)
        fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
        cut = starts[faces, None, None] + fan
        if 3 < count <= MAX_EAR_CORNERS:
            for row in np.flatnonzero(_folded(points[indices[cut]])):
                ring = starts[faces[row]] + np.arange(count)
                cut[row] = ring[_ears(points[indices[ring]])]
        corners.append(cut.reshape(-1, 3))
        owners.append(np.repeat(faces, count - 2))
    if not corners:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    joined, owner = np.concatenate(corners), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return joined[order], owner[order]


def _folded(fans: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for fans [F, N, 3, 3] whether a triangle faces away from its polygon."""
    cross = np.cross(fans[:, :, 1] - fans[:, :, 0], fans[:, :, 2] - fans[:, :, 0])
    facing = np.einsum("fni,fi->fn", cross, cross.sum(axis=1))
    return np.asarray((facing < 0).any(axis=1))


def _ears(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the triangles [N - 2, 3] of one polygon [N, 3], by cutting off ears."""
    flat = _flattened(points)
    ring = list(range(len(flat)))
    found = []
    while len(ring) > 3:
        at = next((i for i in range(len(ring)) if _is_ear(flat, ring, i)), 0)
        found.append([ring[at - 1], ring[at], ring[(at + 1) % len(ring)]])
        del ring[at]
    return np.array([*found, ring])


def _flattened(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a polygon [N, 2] in the plane of its normal, counter-clockwise."""
    ahead = np.roll(points, -1, axis=0)
    normal = np.cross(points, ahead).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    flat = np.delete(points, axis, axis=1)
    mirrored = (normal[axis] < 0) != (axis == 1)
    return flat * np.array([-1.0, 1.0]) if mirrored else flat


def _is_ear(flat: NDArray[np.float64], ring: list[int], at: int) -> bool:
    before, here, after = ring[at - 1], ring[at], ring[(at + 1) % len(ring)]
    a, b, c = flat[before], flat[here], flat[after]
    if _turn(a, b, c) <= 0:
        return False
    others = [i for i in ring if i not in (before, here, after)]
    return not any(
        _turn(a, b, flat[i]) >= 0 and _turn(b, c, flat[i]) >= 0 and _turn(c, a, flat[i]) >= 0
        for i in others
    )


def _turn(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
