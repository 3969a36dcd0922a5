"""Decimation by merging vertices that share a cell of a grid (Rossignac and Borrel 1993).

Coarser than edge collapse at the same budget, but it is a dozen lines of numpy that cannot crash,
hang or leave the bounding box, whatever the topology. It therefore takes the meshes on which the
native decimation has been seen to die.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.mesh import TriangleMesh
from storage.errors import Rejected

_FINEST = 1024
"""Cells along the box that the search starts from; more would not fit any budget that we use."""


def vertex_clustering(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the mesh on the finest grid that leaves at most `budget` faces.

    The number of faces is almost monotone in the number of cells, so the search is by halving; it
    may miss the very finest grid. Raises Rejected `budget_missed` where no grid leaves a face.
    """
    coarse, fine = 1, _FINEST
    best = None
    while coarse <= fine:
        middle = (coarse + fine) // 2
        trial = _merge_cells(mesh, middle)
        if len(trial.faces) <= budget:
            best, coarse = trial, middle + 1
        else:
            fine = middle - 1
    if best is None or len(best.faces) == 0:
        raise Rejected("budget_missed", f"no grid leaves between 1 and {budget} faces")
    return best


def _merge_cells(mesh: TriangleMesh, cells_per_side: int) -> TriangleMesh:
    """Merge the vertices of each cell into their mean, weighted by the area around them."""
    cell = np.floor((mesh.positions + 0.5) * cells_per_side).astype(np.int64)
    cell = np.clip(cell, 0, cells_per_side - 1)
    key = (cell[:, 0] * cells_per_side + cell[:, 1]) * cells_per_side + cell[:, 2]
    _, cluster = np.unique(key, return_inverse=True)
    weight = _vertex_areas(mesh)
    total = np.bincount(cluster, weights=weight)
    sums = [np.bincount(cluster, weights=weight * axis) for axis in mesh.positions.T]
    faces = cluster[mesh.faces]
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces = faces[distinct]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return TriangleMesh(positions=np.stack(sums, axis=1) / total[:, None], faces=faces[first])


def _vertex_areas(mesh: TriangleMesh) -> NDArray[np.float64]:
    area = np.linalg.norm(mesh.double_area_vectors, axis=1)
    corner_areas, count = np.repeat(area, 3), len(mesh.positions)
    return np.bincount(mesh.faces.ravel(), corner_areas, count).astype(np.float64)
