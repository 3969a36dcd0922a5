"""Decimation and even remeshing by two filters of pymeshlab, with every parameter stated.

pymeshlab takes a missing parameter from the previous call in the same process, so that results
would depend on history. It may crash or hang: these functions run in child processes only.
"""

import os
import sys
from types import ModuleType

import numpy as np

from pipeline.foreign.mesh import TriangleMesh
from pipeline.isolation.stand_in_library import load_library
from storage.errors import Rejected


def _import_pymeshlab() -> ModuleType:
    """Return pymeshlab, also where the system has no OpenGL.

    OpenGL's functions are then looked up when they are called, which never happens here.
    """
    for name in ("libGL.so.1", "libOpenGL.so.0"):
        load_library(name)
    flags = sys.getdlopenflags()
    sys.setdlopenflags(os.RTLD_LAZY)
    try:
        import pymeshlab

        return pymeshlab
    finally:
        sys.setdlopenflags(flags)


pymeshlab = _import_pymeshlab()

REQUIRED_FILTERS = (
    "meshing_decimation_quadric_edge_collapse",
    "meshing_isotropic_explicit_remeshing",
)
"""Names of the pymeshlab filters that the stage calls."""

_COLLAPSE = {
    "targetperc": 0.0,
    "qualitythr": 0.15,
    "preserveboundary": False,
    "boundaryweight": 0.2,
    "preservenormal": True,
    "preservetopology": False,
    "optimalplacement": True,
    "planarquadric": True,
    "planarweight": 0.0001,
    "qualityweight": False,
    "autoclean": True,
    "selected": False,
}
"""Values chosen on 148 objects (study S39): the planar term and the check of normals keep flat
areas from folding, the low boundary weight keeps borders from spiking."""

_REMESH = {
    "iterations": 10,
    "adaptive": False,
    "selectedonly": False,
    "featuredeg": 60.0,
    "checksurfdist": True,
    "maxsurfdist": pymeshlab.PercentageValue(1.0),
    "splitflag": True,
    "collapseflag": True,
    "swapflag": True,
    "smoothflag": True,
    "reprojectflag": True,
}

_FILL = 0.9
"""Fraction of the budget that remeshing aims at: its edge length holds on average only, and the
collapse that trims the excess would undo the evenness."""


def collapse(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the mesh collapsed to at most `budget` faces, in almost all cases.

    Quadric edge collapse (Garland and Heckbert 1997). Raises Rejected `decimation_failed` where
    pymeshlab reports an error.
    """
    return _apply(
        mesh, "meshing_decimation_quadric_edge_collapse", {"targetfacenum": budget, **_COLLAPSE}
    )


def remesh_evenly(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the surface remeshed to at most `budget` even triangles, in almost all cases.

    Isotropic explicit remeshing (Hoppe et al. 1993; Botsch and Kobbelt 2004) to the edge length
    that fills most of the budget with equilateral triangles. A source with fewer triangles than the
    budget gains some. Raises Rejected `decimation_failed` too.
    """
    edge = float(np.sqrt(4 * float(mesh.areas.sum()) / (np.sqrt(3) * _FILL * budget)))
    length = {"targetlen": pymeshlab.PureValue(edge)}
    even = _apply(mesh, "meshing_isotropic_explicit_remeshing", {**_REMESH, **length})
    return collapse(even, budget) if len(even.faces) > budget else even


def _apply(mesh: TriangleMesh, name: str, parameters: dict) -> TriangleMesh:
    meshes = pymeshlab.MeshSet(verbose=False)
    try:
        meshes.add_mesh(pymeshlab.Mesh(mesh.positions, mesh.faces.astype(np.int32)))
        meshes.apply_filter(name, **parameters)
    except pymeshlab.PyMeshLabException as error:
        raise Rejected("decimation_failed", f"pymeshlab has no result of {name}") from error
    result = meshes.current_mesh()
    return TriangleMesh(
        positions=result.vertex_matrix(), faces=result.face_matrix().astype(np.int64)
    )
