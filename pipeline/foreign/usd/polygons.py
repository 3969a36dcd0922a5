"""A mesh or solid of a stage as triangles of its checked polygons.

Round solids of UsdGeom are polygons of 48 sides with corners on the surface: their area is 0.3 %
too small.
"""

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import UsdGeom

from pipeline.foreign.polygons import triangulate
from pipeline.foreign.usd.placed import SOLIDS, PlacedPrim
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

    def read_primvar(self, name: str) -> NDArray | None:
        """Return a primvar of the mesh, or an inherited one, at corners [T, 3, ...].

        None where there is none, or not for every corner.
        """
        primvar = UsdGeom.PrimvarsAPI(self.prim).FindPrimvarWithInheritance(name)
        if not primvar or not primvar.HasValue():
            return None
        values = np.array(primvar.ComputeFlattened(self.placed.time))
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

    def read_coordinates(self, primvar: str) -> NDArray[np.float64]:
        """Return texture coordinates [T, 3, 2], perhaps not finite; NaN where one is missing."""
        values = self.read_primvar(primvar)
        if values is None or values.ndim != 3 or values.shape[2] < 2:
            return np.full((len(self.corners), 3, 2), np.nan)
        return np.asarray(values[..., :2], np.float64)


def cut_mesh(placed: PlacedPrim, max_faces: int | None = None) -> CutMesh:
    """Return the triangles of a mesh or solid, posed by its skeleton, without its holes.

    A mirroring transform reverses the order of corners. More than `max_faces` triangles are not
    cut.

    Raises:
        Rejected: too_many_faces.
        TrilightError: its arrays contradict each other, or are not finite.
    """
    prim = placed.prim
    holes = as_array(None, np.int64, (-1,))
    if prim.GetTypeName() in SOLIDS:
        points, counts, indices, is_smooth = _build_solid(placed)
    else:
        points = as_array(placed.value("points"), np.float64, (-1, 3))
        if placed.skin is not None and len(points):
            points = placed.skin.pose(placed)
        names = ("faceVertexCounts", "faceVertexIndices", "holeIndices")
        counts, indices, holes = (as_array(placed.value(name), np.int64, (-1,)) for name in names)
        is_smooth = placed.value("subdivisionScheme") != "none"
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


_SIDES = 48
_AXES = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}
"""Permutations of coordinates that rotate the Z axis to another one."""

Polygons = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], bool]
"""Points [P, 3], corner counts [F], point indices of corners, and whether the solid is round."""


def _build_solid(placed: PlacedPrim) -> Polygons:
    """Return the polygons of a prim whose type is in SOLIDS."""
    kind = str(placed.prim.GetTypeName())
    read_size = placed.number
    if kind == "TetMesh":
        return _read_tetrahedra(placed)
    if kind == "Cube":
        corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
        sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
        return corners * read_size("size") / 2, np.full(6, 4), np.ravel(sides), False
    axis = "Z" if kind == "Sphere" else str(placed.prim.GetAttribute("axis").Get())
    if kind == "Plane":
        wide = read_size("width") / 2
        long = read_size("length") / 2
        if axis != "Z":  # the permutation swaps the two directions for X and Y
            wide, long = long, wide
        flat = np.array([[-wide, -long, 0], [wide, -long, 0], [wide, long, 0], [-wide, long, 0]])
        return flat[:, _AXES[axis]], np.array([4]), np.arange(4), False
    points, counts, indices = _revolve(_build_profile(kind, read_size))
    return points[:, _AXES[axis]], counts, indices, True


def _build_profile(kind: str, read_size: Any) -> NDArray[np.float64]:
    """Return radii and heights [N, 2] of a solid of revolution, from bottom to top."""
    if kind == "Sphere":
        return _build_arc(-np.pi / 2, np.pi / 2, _SIDES // 2) * read_size("radius")
    top = read_size("radiusTop" if kind.endswith("_1") else "radius")
    bottom = read_size("radiusBottom" if kind.endswith("_1") else "radius")
    half = read_size("height") / 2
    if kind.startswith("Capsule"):  # its end spheres touch the cone between them
        tilt = np.arctan2(bottom - top, 2 * half)
        ends = [(-half, bottom, -np.pi / 2, tilt), (half, top, tilt, np.pi / 2)]
        return np.concatenate([
            _build_arc(begin, end, _SIDES // 4) * radius / np.cos(tilt)
            + np.array([0, up - radius * np.tan(tilt)])
            for up, radius, begin, end in ends
        ])  # fmt: skip
    edge = 0.0 if kind == "Cone" else top
    return np.array([[0, -half], [bottom, -half], [edge, half], [0, half]])


def _build_arc(begin: float, end: float, count: int) -> NDArray[np.float64]:
    angle = np.linspace(begin, end, count + 1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _revolve(
    profile: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the polygons of a profile revolved around Z, facing out; arrays as in `Polygons`."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [np.column_stack([around * radius, np.full(_SIDES, up)]) for radius, up in profile]
    on_axis = profile[:, :1] < 1e-9 * profile[:, 0].max(initial=1e-30)
    number = np.arange(len(profile) * _SIDES).reshape(-1, _SIDES)
    number = np.where(on_axis, number[:, :1], number)  # the points of such a ring are one
    after = np.roll(number, -1, axis=1)
    sides = np.stack([number[:-1], after[:-1], after[1:], number[1:]], axis=-1).reshape(-1, 4)
    is_corner = sides != np.roll(sides, 1, axis=1)
    is_corner[is_corner.sum(axis=1) < 3] = False
    counts = is_corner.sum(axis=1)
    return np.concatenate(rings), counts[counts > 0], sides[is_corner]


def _read_tetrahedra(placed: PlacedPrim) -> Polygons:
    faces = placed.value("surfaceFaceVertexIndices")
    if not faces:
        faces = UsdGeom.TetMesh.ComputeSurfaceFaces(UsdGeom.TetMesh(placed.prim), placed.time)
    points = np.array(placed.value("points") or np.zeros((0, 3)), np.float64)
    sides = np.array(faces or np.zeros((0, 3)), np.int64).reshape(-1, 3)
    return points, np.full(len(sides), 3), sides.ravel(), False
