"""Decimation of meshes by named methods, and the search for the smallest budget that passes."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import igl
import numpy as np

from pipeline.assets.cleaning.clean import clean, normalize
from pipeline.assets.decimation import meshopt
from pipeline.assets.quality.measure import faces_of_edges
from pipeline.assets.recipe import methods_of
from pipeline.assets.settings import Profile
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected

Result = TypeVar("Result")

_DETOUR = 8
"""Multiple of the budget to which meshoptimizer first simplifies larger sources (beyond 1.25 times
it): its errors at that size are far below those of the collapse that follows. Measured on 71
objects (study S38): a third to a twentieth of the time, and no more error."""

_MAX_VALENCE = 512
_MAX_FACES_PER_EDGE = 8
"""Limits beyond which edge collapse and remeshing ran without end."""

_STEP = 2 ** (1 / 8)
"""Ratio of neighboring budgets: the result has at most 9 % more triangles than the smallest
possible one, and one more trial would halve that."""

_FEWEST = 4
"""Faces of the smallest closed surface."""


def collapse_by_qslim(mesh: TriangleMesh, budget: int) -> TriangleMesh:
    """Return the mesh with at most `budget` faces where its topology allows that many collapses.

    Quadric edge collapse by libigl (Garland and Heckbert 1997), without GPL. On 153 levels its mean
    error was 0.88 times that of pymeshlab's collapse (docs/results/meshes.md). It collapses nothing
    where an edge has more than two faces, so such edges are split first.
    """
    faces, sources = igl.split_nonmanifold(np.asfortranarray(mesh.faces, np.int32))[:2]
    positions = np.asfortranarray(mesh.positions[np.ravel(sources)])
    positions, faces = igl.qslim(positions, np.asfortranarray(faces, np.int32), budget)[:2]
    return TriangleMesh(
        positions=np.ascontiguousarray(positions), faces=np.ascontiguousarray(faces, np.int64)
    )


_METHODS: Mapping[str, Callable[[TriangleMesh, int], TriangleMesh]] = {
    "libigl_qslim": collapse_by_qslim,
    "libigl_qslim_alone": collapse_by_qslim,
    "meshoptimizer": meshopt.simplify,
    "meshoptimizer_sloppy": meshopt.simplify_sloppily,
}
"""Methods by the names that `recipe.methods_of` lists in order of trial, without pymeshlab's."""
_MAY_HANG = ("pymeshlab_uniform", "pymeshlab_collapse")
_AFTER_MESHOPTIMIZER = (*_MAY_HANG, "libigl_qslim")


def decimate(mesh: TriangleMesh, budget: int, method: str) -> TriangleMesh:
    """Return a mesh of about `budget` faces by a method of `recipe.methods_of`; raises Rejected."""
    if method in _AFTER_MESHOPTIMIZER and len(mesh.faces) > 1.25 * _DETOUR * budget:
        mesh = clean(meshopt.simplify(mesh, _DETOUR * budget))
    if method in _MAY_HANG:
        from pipeline.assets.decimation.pymeshlab_filters import collapse, remesh_evenly

        return (remesh_evenly if method == "pymeshlab_uniform" else collapse)(mesh, budget)
    return _METHODS[method](mesh, budget)


def safe_method(mesh: TriangleMesh, method: str) -> str:
    """Return `method`, or `meshoptimizer` where that method might not end on the mesh."""
    if method not in _MAY_HANG:
        return method
    valence = np.bincount(mesh.faces.ravel()).max()
    wild = valence > _MAX_VALENCE or faces_of_edges(mesh).max() > _MAX_FACES_PER_EDGE
    return "meshoptimizer" if wild else method


def remesh(raw: TriangleMesh, num_faces: int, profile: Profile = "uniform") -> TriangleMesh:
    """Return the surface with at most `num_faces` triangles, in the units of the file.

    This is the mesh stage without its quality checks; RenderFormer's own remeshing gives other
    triangles.

    Raises:
        Rejected: "remesh_failed" where no method gives that many.
        TrilightError: `uniform` without pymeshlab.
    """
    used = raw.positions[np.unique(raw.faces)]
    low = used.min(axis=0)
    high = used.max(axis=0)
    unit = clean(normalize(raw))
    if len(unit.faces):
        for method in methods_of(profile):
            try:
                result = decimate(unit, num_faces, safe_method(unit, method))
            except Rejected:
                continue
            if 0 < len(result.faces) <= num_faces:
                positions = result.positions * (high - low).max() + (low + high) / 2
                return TriangleMesh(positions=positions, faces=result.faces)
    raise Rejected("remesh_failed", f"no method gives at most {num_faces} triangles")


def smallest_passing(attempt: Callable[[int], Result], largest: int) -> Result:
    """Return the result of `attempt` at the smallest budget up to `largest` that it accepts.

    Bisection over falling budgets: six or seven attempts. The error of a decimation is almost, not
    exactly, monotonic in its budget, so the search may miss a smaller budget that passes; the
    returned result always passed.

    Raises:
        Rejected: `largest` itself does not pass.
    """
    budgets = [largest]
    budget = float(largest)
    while (budget := budget / _STEP) >= _FEWEST:
        if round(budget) < budgets[-1]:
            budgets.append(round(budget))
    best = attempt(largest)
    passed = 0
    failed = len(budgets)
    while failed - passed > 1:
        middle = (passed + failed) // 2
        try:
            best = attempt(budgets[middle])
            passed = middle
        except Rejected:
            failed = middle
    return best
