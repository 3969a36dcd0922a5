"""The decimations by name, and the meshes that pymeshlab must not see."""

import numpy as np

from pipeline.assets.cleaning.clean import clean
from pipeline.assets.decimation import meshopt
from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.quality.triangles import count_edges

_DETOUR = 8
"""Sources with more than this many times the budget, and a quarter, are first simplified to it by
meshoptimizer: its mistakes at that size are far below those of the collapse that follows. Measured
on 71 objects (LOG.md): a third to a twentieth of the time, and no more error."""

_MAX_VALENCE = 512
_MAX_FACES_PER_EDGE = 8
"""Beyond these, edge collapse and remeshing have been seen to run without end."""


def decimate(mesh: TriangleMesh, budget: int, method: str) -> TriangleMesh:
    """Return a mesh of about `budget` faces by a method of `recipe.methods_of`; raises Rejected."""
    if method.startswith("pymeshlab"):
        from pipeline.assets.decimation import pymeshlab_filters  # may not be installed

        if len(mesh.faces) > 1.25 * _DETOUR * budget:
            mesh = clean(meshopt.simplify(mesh, _DETOUR * budget))
        if method == "pymeshlab_uniform":
            return pymeshlab_filters.remesh_evenly(mesh, budget)
        return pymeshlab_filters.collapse(mesh, budget)
    if method == "meshoptimizer":
        return meshopt.simplify(mesh, budget)
    assert method == "meshoptimizer_sloppy", method
    return meshopt.simplify_sloppily(mesh, budget)


def safe_method(mesh: TriangleMesh, method: str) -> str:
    """Return `method`, or `meshoptimizer` for a mesh on which pymeshlab would not end."""
    if not method.startswith("pymeshlab"):
        return method
    valence = np.bincount(mesh.faces.ravel()).max()
    wild = valence > _MAX_VALENCE or count_edges(mesh).most_faces > _MAX_FACES_PER_EDGE
    return "meshoptimizer" if wild else method
