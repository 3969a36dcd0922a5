"""Polygons of UsdGeom's cubes, spheres, cylinders, cones, capsules, planes and tetrahedra.

Round solids are polygons of 48 sides with corners on the surface: their area is 0.3 % too small.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.numbers import read_number

SOLIDS = ("Cube", "Sphere", "Cylinder", "Cylinder_1", "Cone", "Capsule", "Capsule_1", "Plane",
          "TetMesh")  # fmt: skip
"""Types of prims that are converted here."""

_SIDES = 48
_AXES = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}
"""Permutations of coordinates that rotate the Z axis to another one."""

Polygons = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], bool]
"""Points [P, 3], corner counts [F], point indices of corners, and whether the solid is round."""


def build_solid(prim: Any, time: Any) -> Polygons:
    """Return the polygons at a time of a prim whose type is in SOLIDS."""
    kind = str(prim.GetTypeName())

    def read_size(name: str) -> float:
        return read_number(prim.GetAttribute(name).Get(time), f"{prim.GetPath()}.{name}")

    if kind == "TetMesh":
        return _read_tetrahedra(prim, time)
    if kind == "Cube":
        corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
        sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
        return _pack(corners * read_size("size") / 2, sides, is_smooth=False)
    axis = "Z" if kind == "Sphere" else str(prim.GetAttribute("axis").Get())
    if kind == "Plane":
        wide = read_size("width") / 2
        long = read_size("length") / 2
        if axis != "Z":  # the permutation swaps the two directions for X and Y
            wide, long = long, wide
        flat = np.array([[-wide, -long, 0], [wide, -long, 0], [wide, long, 0], [-wide, long, 0]])
        return _pack(flat[:, _AXES[axis]], [[0, 1, 2, 3]], is_smooth=False)
    points, sides = _revolve(_build_profile(kind, read_size))
    return _pack(points[:, _AXES[axis]], sides, is_smooth=True)


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


def _revolve(profile: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return the points and polygons of a profile revolved around Z, facing out."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [np.column_stack([around * radius, np.full(_SIDES, up)]) for radius, up in profile]
    sides = [
        [_SIDES * row + i, _SIDES * row + j, _SIDES * (row + 1) + j, _SIDES * (row + 1) + i]
        for row in range(len(profile) - 1)
        for i, j in zip(range(_SIDES), [*range(1, _SIDES), 0], strict=True)
    ]
    on_axis = profile[:, 0] < 1e-9 * profile[:, 0].max(initial=1e-30)
    first = np.arange(len(profile) * _SIDES) // _SIDES
    same = np.where(on_axis[first], first * _SIDES, np.arange(len(first)))
    distinct_sides = [list(dict.fromkeys(same[side].tolist())) for side in sides]
    return np.concatenate(rings), [side for side in distinct_sides if len(side) > 2]


def _read_tetrahedra(prim: Any, time: Any) -> Polygons:
    from pxr import UsdGeom

    mesh = UsdGeom.TetMesh(prim)
    faces = mesh.GetSurfaceFaceVertexIndicesAttr().Get(time)
    if not faces:
        faces = UsdGeom.TetMesh.ComputeSurfaceFaces(mesh, time)
    points = np.array(mesh.GetPointsAttr().Get(time) or np.zeros((0, 3)), np.float64)
    sides = np.array(faces or np.zeros((0, 3)), np.int64).reshape(-1, 3)
    return points, np.full(len(sides), 3), sides.ravel(), False


def _pack(
    points: NDArray[np.float64], sides: Sequence[Sequence[int]], *, is_smooth: bool
) -> Polygons:
    counts = np.array([len(side) for side in sides], np.int64)
    return points, counts, np.array([i for side in sides for i in side], np.int64), is_smooth
