"""Quadric edge collapse decimation by libigl (Garland and Heckbert 1997), without GPL.

On 153 levels its mean error was 0.88 times that of pymeshlab's collapse (docs/results/meshes.md).
It collapses nothing where an edge has more than two faces, so such edges are split first.
"""

import igl
import numpy as np

from pipeline.foreign.mesh import TriangleMesh


def collapse(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the mesh with at most `budget` faces where its topology allows that many collapses."""
    faces, sources = igl.split_nonmanifold(np.asfortranarray(mesh.faces, np.int32))[:2]
    positions = np.asfortranarray(mesh.positions[np.ravel(sources)])
    positions, faces = igl.qslim(positions, np.asfortranarray(faces, np.int32), budget)[:2]
    return TriangleMesh(
        positions=np.ascontiguousarray(positions), faces=np.ascontiguousarray(faces, np.int64)
    )
