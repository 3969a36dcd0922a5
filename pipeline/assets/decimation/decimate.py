"""Decimation of meshes by named methods, and the check for meshes that may hang pymeshlab."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.assets.cleaning.clean import clean
from pipeline.assets.decimation import meshopt, qslim
from pipeline.assets.quality.triangles import count_edges
from pipeline.foreign.mesh import TriangleMesh

_DETOUR = 8
"""Multiple of the budget to which meshoptimizer first simplifies larger sources (beyond 1.25 times
it): its errors at that size are far below those of the collapse that follows. Measured on 71
objects (study S38): a third to a twentieth of the time, and no more error."""

_MAX_VALENCE = 512
_MAX_FACES_PER_EDGE = 8
"""Limits beyond which edge collapse and remeshing ran without end."""


@dataclass(frozen=True, kw_only=True)
class Decimation:
    """A decimation method."""

    run: Callable[[TriangleMesh, int], TriangleMesh]
    """Returns a mesh of about the given number of faces; raises Rejected."""
    always_ends: bool
    """True where the method ends on every mesh."""


def _simplify_first(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    if len(mesh.faces) > 1.25 * _DETOUR * budget:
        return clean(meshopt.simplify(mesh, _DETOUR * budget))
    return mesh


def _remesh_evenly(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    from pipeline.assets.decimation import pymeshlab_filters  # may not be installed

    return pymeshlab_filters.remesh_evenly(_simplify_first(mesh, budget), budget)


def _collapse(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    from pipeline.assets.decimation import pymeshlab_filters  # may not be installed

    return pymeshlab_filters.collapse(_simplify_first(mesh, budget), budget)


def _qslim(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    return qslim.collapse(_simplify_first(mesh, budget), budget)


DECIMATIONS: Mapping[str, Decimation] = {
    "pymeshlab_uniform": Decimation(run=_remesh_evenly, always_ends=False),
    "pymeshlab_collapse": Decimation(run=_collapse, always_ends=False),
    "libigl_qslim": Decimation(run=_qslim, always_ends=True),
    "libigl_qslim_alone": Decimation(run=qslim.collapse, always_ends=True),
    "meshoptimizer": Decimation(run=meshopt.simplify, always_ends=True),
    "meshoptimizer_sloppy": Decimation(run=meshopt.simplify_sloppily, always_ends=True),
}
"""Methods by the names that `recipe.methods_of` lists in order of trial."""


def decimate(mesh: TriangleMesh, budget: int, method: str) -> TriangleMesh:
    """Return a mesh of about `budget` faces by a method of `recipe.methods_of`; raises Rejected."""
    return DECIMATIONS[method].run(mesh, budget)


def safe_method(mesh: TriangleMesh, method: str) -> str:
    """Return `method`, or `meshoptimizer` where that method might not end on the mesh."""
    if DECIMATIONS[method].always_ends:
        return method
    valence = np.bincount(mesh.faces.ravel()).max()
    wild = valence > _MAX_VALENCE or count_edges(mesh).most_faces > _MAX_FACES_PER_EDGE
    return "meshoptimizer" if wild else method
