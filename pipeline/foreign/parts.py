"""The triangles of a file with their materials: the same ones that `load` gives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import SourceMaterial
from pipeline.foreign.mesh import FileMesh, TriangleMesh


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedParts:
    """The triangles of a source, unwelded, in its own units, +Z up."""

    mesh: TriangleMesh
    """Its triangles."""
    material: NDArray[np.int64]
    """[F] row of `materials`."""
    materials: Sequence[SourceMaterial]
    """What surfaces are made of."""
    uv: NDArray[np.float64]
    """[F, S, 3, 2] coordinates of each set at each corner, v up; not a number where there are none.
    """
    colour: NDArray[np.float64] | None = None
    """[F, 3, 3] linear colour of each corner, times the base colour; None where it is white."""


def build_parts(
    contents: FileMesh, materials: Sequence[SourceMaterial], default: SourceMaterial
) -> TexturedParts:
    """Return the triangles of a file, given its materials and that of faces without any."""
    count = len(contents.mesh.faces)
    rows = np.full(count, -1) if contents.material is None else contents.material
    uv = np.full((count, 3, 2), np.nan) if contents.uv is None else contents.uv
    return TexturedParts(
        mesh=contents.mesh,
        material=np.where(rows < 0, len(materials), rows),
        materials=(*materials, default),
        uv=uv[:, None],
        colour=contents.color,
    )
