"""Decimation meets its budget, does not remember, and knows which meshes to keep away from."""

import numpy as np
import pymeshlab
import pytest

from pipeline.assets.decimation.by_name import decimate, safe_method
from pipeline.assets.decimation.pymeshlab_filters import REQUIRED_FILTERS
from pipeline.assets.environment import missing_filters
from pipeline.assets.mesh import TriangleMesh
from pipeline.assets.quality.distance import Surface
from pipeline.assets.recipe import methods_of
from storage.errors import Rejected
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import cleaned, knot, sphere

UNIFORM = np.random.default_rng(0).random((4000, 3))
METHODS = methods_of("uniform")
"""All four of them."""
USED = {"meshoptimizer_sloppy": 0.5}
"""Least share of the budget that is used, where it is not 0.8: clustering moves in steps of its
grid."""


def p99(mesh: TriangleMesh, budget: int, method: str) -> float:
    return Surface(mesh, UNIFORM).deviation(decimate(mesh, budget, method)).two_way(99)


@for_each("method", METHODS)
def test_budgets_are_met_and_the_error_falls_with_them(method: str) -> None:
    mesh = cleaned(knot())
    surface, errors = Surface(mesh, UNIFORM), []
    for budget in (1600, 800, 300):
        result = decimate(mesh, budget, method)
        # A budget is worth little if much of it stays unused.
        assert USED.get(method, 0.8) * budget <= len(result.faces) <= budget
        errors.append(surface.deviation(result).two_way(99))
    assert errors == sorted(errors)
    # Cells of clustering at 1600 faces are 1/19 of the box; vertices move by a good part of half.
    assert errors[0] < 0.02


def test_free_vertices_come_closer_than_those_of_the_source_and_these_than_clusters() -> None:
    mesh = cleaned(knot())
    names = ("pymeshlab_collapse", "meshoptimizer", "meshoptimizer_sloppy")
    free, subset, clusters = (p99(mesh, 600, name) for name in names)
    # Measured 0.6 and 0.3.
    assert free < 0.8 * subset < 0.5 * clusters


def _call_with(flag: bool) -> None:
    """Call both filters with one of two values of every parameter."""
    mesh = cleaned(knot(80, 8))
    other = pymeshlab.MeshSet(verbose=False)
    other.add_mesh(pymeshlab.Mesh(mesh.positions, mesh.faces.astype(np.int32)))
    collapse = ("preserveboundary", "preservenormal", "preservetopology", "optimalplacement")
    other.meshing_decimation_quadric_edge_collapse(
        targetfacenum=600 if flag else 300,
        qualitythr=1.0 if flag else 0.01,
        boundaryweight=5.0 if flag else 0.01,
        planarweight=0.1 if flag else 1e-6,
        **dict.fromkeys((*collapse, "planarquadric", "qualityweight", "autoclean"), flag),
    )
    remesh = ("splitflag", "collapseflag", "swapflag", "smoothflag", "reprojectflag")
    other.meshing_isotropic_explicit_remeshing(
        iterations=2 if flag else 1,
        featuredeg=5.0 if flag else 170.0,
        targetlen=pymeshlab.PercentageValue(7.0 if flag else 3.0),
        maxsurfdist=pymeshlab.PercentageValue(7.0 if flag else 0.1),
        **dict.fromkeys((*remesh, "adaptive", "checksurfdist"), flag),
    )


@pytest.mark.parametrize("method", ["pymeshlab_collapse", "pymeshlab_uniform"])
def test_earlier_calls_leave_no_trace(method: str) -> None:
    """pymeshlab takes omitted parameters from the previous call of the process."""
    mesh = cleaned(knot())
    results = []
    for flag in (True, False):
        _call_with(flag)
        results.append(decimate(mesh, 500, method))
    first, second = results
    assert np.array_equal(first.positions, second.positions)
    assert np.array_equal(first.faces, second.faces)


@pytest.mark.parametrize(
    ("method", "offset"),
    [("pymeshlab_collapse", 0), ("pymeshlab_collapse", 10_000), ("pymeshlab_uniform", 0)],
)
def test_what_pymeshlab_refuses_is_a_rejection(method: str, offset: int) -> None:
    ball = sphere()
    faces = ball.faces + offset if offset else ball.faces[:0]
    with pytest.raises(Rejected, match="decimation_failed"):
        decimate(TriangleMesh(positions=ball.positions, faces=faces), 100, method)


@pytest.mark.parametrize("method", ["meshoptimizer", "meshoptimizer_sloppy"])
def test_meshoptimizer_invents_no_vertex(method: str) -> None:
    mesh = cleaned(knot())
    result = decimate(mesh, 200, method)
    used = set(map(tuple, result.positions[np.unique(result.faces)].tolist()))
    assert used <= set(map(tuple, mesh.positions.tolist()))


def test_wild_meshes_are_kept_from_native_code() -> None:
    rim = np.arange(600)
    wheel = TriangleMesh(
        positions=np.column_stack([np.cos(rim), np.sin(rim), 0.001 * rim]),
        faces=np.column_stack([np.zeros(598, np.int64), rim[1:-1], rim[2:]]),
    )
    pages = TriangleMesh(
        positions=np.random.default_rng(4).random((12, 3)),
        faces=np.array([[0, 1, page] for page in range(2, 12)]),
    )
    for method in ("pymeshlab_collapse", "pymeshlab_uniform"):
        assert safe_method(wheel, method) == "meshoptimizer"
        assert safe_method(pages, method) == "meshoptimizer"
        assert safe_method(cleaned(sphere()), method) == method
    assert safe_method(wheel, "meshoptimizer_sloppy") == "meshoptimizer_sloppy"


def test_pymeshlab_has_what_we_use() -> None:
    assert missing_filters() == []


def test_a_missing_filter_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pymeshlab, "filter_list", lambda: ["compute_scalar_by_something"])
    assert missing_filters() == list(REQUIRED_FILTERS)
