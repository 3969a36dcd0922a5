"""`TriangleMesh` and `FileMesh`: the arrays of a mesh, and the attributes that its file states."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.conventions import linear_from_srgb, linear_from_srgb8


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleMesh:
    """Triangles in double precision with signed indices."""

    positions: NDArray[np.float64]
    """[V, 3] in the units of the source before `normalise`, in the unit box after it."""
    faces: NDArray[np.int64]
    """[F, 3] rows of `positions`."""

    @property
    def corners(self) -> NDArray[np.float64]:
        """[F, 3, 3] the three positions of every face."""
        return self.positions[self.faces]

    @property
    def double_area_vectors(self) -> NDArray[np.float64]:
        """[F, 3] normal of every face, as long as twice its area."""
        corners = self.corners
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @property
    def areas(self) -> NDArray[np.float64]:
        """[F] area of every face."""
        return 0.5 * np.linalg.norm(self.double_area_vectors, axis=1)

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.positions, axis=0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class FileMesh:
    """The contents of a file of one mesh, in its own units."""

    mesh: TriangleMesh
    """Unwelded triangles; the points alone where there are none."""
    material: NDArray[np.int64] | None = None
    """[F] row of `material_names`, or -1; None where the file knows no materials."""
    material_names: tuple[str, ...] = ()
    """Names of materials, or of the pictures used as such."""
    uv: NDArray[np.float64] | None = None
    """[F, 3, 2] texture coordinates of corners, v up; not a number where a corner has none."""
    color: NDArray[np.float64] | None = None
    """[F, 3, 3] linear color of corners."""
    is_single: bool = False
    """True where the file stores positions in single precision."""
    unread: tuple[str, ...] = ()
    """Short sentences on contents of the file that are not read."""


def decode_colors(codes: NDArray) -> NDArray[np.float64]:
    """Return linear colors [N, 3] of sRGB codes: integers, or numbers up to 1 or else 255."""
    if codes.dtype == np.uint8:
        return linear_from_srgb8()[codes].astype(np.float64)
    coded = np.nan_to_num(codes.astype(np.float64))
    if codes.dtype == np.uint16 and codes.max(initial=0) > 255:
        coded /= 65535
    elif coded.size and coded.max() > 1:
        coded /= 255
    return np.asarray(linear_from_srgb(np.clip(coded, 0, 1)), np.float64)


def join_meshes(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Return all meshes, at least one, as one; no vertices are welded."""
    starts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return TriangleMesh(
        positions=np.concatenate([mesh.positions for mesh in meshes]), faces=np.concatenate(faces)
    )
