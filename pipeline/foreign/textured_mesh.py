"""The triangles of a file with their materials, the same triangles as those of `load_mesh`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.material import SourceMaterial
from pipeline.foreign.mesh import TriangleMesh


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedMesh:
    """The triangles of a source, unwelded, in its own units, +Z up."""

    mesh: TriangleMesh
    material: NDArray[np.int64]
    """[F] index into `materials` of each face."""
    materials: Sequence[SourceMaterial]
    uv: NDArray[np.float64]
    """[F, S, 3, 2] texture coordinates of corners by set S, v up; NaN where there are none."""
    tangent: NDArray[np.float64] | None = None
    """[F, 3, 4] tangent of each corner, and the sign of its bitangent, where the file states them;
    NaN where it does not."""
    color: NDArray[np.float64] | None = None
    """[F, 3, 3] linear tint of each corner, multiplied with the base color; None for white."""
