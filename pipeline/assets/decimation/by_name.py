"""Fewer triangles: the methods by name, the one that is tried first leading.

Quadric edge collapse (Garland and Heckbert 1997, pymeshlab's) is several times closer to the
source than vertex clustering at the same budget, but is native code that some meshes kill. The
caller runs it in a child process and, should the child die, asks another child for the next method.
"""

from collections.abc import Callable, Mapping

import numpy as np
import pymeshlab

from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.recipe import METHODS
from pipeline.assets.vertex_clustering import vertex_clustering
from storage.errors import Rejected

REQUIRED_FILTERS = ("meshing_decimation_quadric_edge_collapse",)
"""Filters of pymeshlab that this stage calls."""

_MAX_VALENCE = 512
_MAX_FACES_PER_EDGE = 8
"""Beyond these, edge collapse has been seen to run without end."""

_COLLAPSE = {
    "targetperc": 0.0,
    "qualitythr": 0.3,
    "preserveboundary": False,
    "boundaryweight": 0.2,
    "preservenormal": False,
    "preservetopology": False,
    "optimalplacement": True,
    "planarquadric": True,
    "planarweight": 0.001,
    "qualityweight": False,
    "autoclean": True,
    "selected": False,
}
"""Every parameter is stated: pymeshlab takes what is left out from the previous call in the same
process, so the result would depend on history. The values were chosen on 148 objects (LOG.md): the
planar term keeps flat parts from folding, the low boundary weight keeps borders from spiking."""


def pymeshlab_qem(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the mesh collapsed to at most `budget` faces, in almost all cases.

    Raises Rejected `decimation_failed` where pymeshlab says so. It may also end the process.
    """
    meshes = pymeshlab.MeshSet(verbose=False)
    try:
        meshes.add_mesh(pymeshlab.Mesh(mesh.positions, mesh.faces.astype(np.int32)))
        meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=budget, **_COLLAPSE)
    except pymeshlab.PyMeshLabException as error:
        raise Rejected("decimation_failed", f"pymeshlab: {error!s:.200}") from error
    result = meshes.current_mesh()
    return TriangleMesh(
        positions=result.vertex_matrix(), faces=result.face_matrix().astype(np.int64)
    )


_BY_NAME: Mapping[str, Callable[[TriangleMesh, int], TriangleMesh]] = dict(
    zip(METHODS, (pymeshlab_qem, vertex_clustering), strict=True)
)


def decimate(mesh: TriangleMesh, budget: int, method: str) -> TriangleMesh:
    """Return a mesh of about `budget` faces by one of METHODS; raises Rejected."""
    return _BY_NAME[method](mesh, budget)


def safe_method(mesh: TriangleMesh, method: str) -> str:
    """Return `method`, or vertex clustering for a mesh on which edge collapse would not end."""
    valence = np.bincount(mesh.faces.ravel()).max()
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    shared = np.unique(edges[:, 0] * len(mesh.positions) + edges[:, 1], return_counts=True)[1].max()
    wild = valence > _MAX_VALENCE or shared > _MAX_FACES_PER_EDGE
    return "vertex_clustering" if wild else method
