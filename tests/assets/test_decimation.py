"""Decimation meets its budget, does not remember, and knows which meshes to keep away from."""

import numpy as np
import pymeshlab
import pytest

from pipeline.assets.clean import clean, normalise
from pipeline.assets.decimation import METHODS, decimate, safe_method
from pipeline.assets.distance import Surface
from pipeline.assets.environment import missing_filters
from pipeline.assets.gate import check_level
from pipeline.assets.mesh import TriangleMesh
from storage.errors import Rejected
from tests.assets.meshes_by_hand import knot, sphere

UNIFORM = np.random.default_rng(0).random((4000, 3))


def prepared(mesh: TriangleMesh) -> TriangleMesh:
    return clean(normalise(mesh))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("budget", [1000, 300])
def test_budgets_are_met(method: str, budget: int) -> None:
    result = decimate(prepared(knot()), budget, method)
    # A budget is worth little if half of it stays unused; clustering moves in steps of its grid.
    assert (0.8 if method == "pymeshlab_qem" else 0.5) * budget <= len(result.faces) <= budget


@pytest.mark.parametrize("method", METHODS)
def test_error_falls_with_the_budget(method: str) -> None:
    mesh = prepared(knot())
    surface = Surface(mesh, UNIFORM)
    errors = [surface.p99_to(decimate(mesh, budget, method)) for budget in (1600, 800, 400, 200)]
    assert errors == sorted(errors)
    # Cells of clustering at 1600 faces are 1/19 of the box; vertices move by a good part of half.
    assert errors[0] < 0.02


def test_edge_collapse_comes_closer_than_clustering() -> None:
    mesh = prepared(knot())
    surface = Surface(mesh, UNIFORM)
    ours = [surface.p99_to(decimate(mesh, 600, method)) for method in METHODS]
    assert ours[0] < 0.6 * ours[1]


def test_earlier_calls_leave_no_trace() -> None:
    """pymeshlab takes omitted parameters from the previous call of the process."""
    mesh = prepared(knot())
    before = decimate(mesh, 500, "pymeshlab_qem")
    other = pymeshlab.MeshSet(verbose=False)
    other.add_mesh(pymeshlab.Mesh(mesh.positions, mesh.faces.astype(np.int32)))
    other.meshing_decimation_quadric_edge_collapse(
        targetfacenum=300,
        qualitythr=1.0,
        preserveboundary=True,
        boundaryweight=5.0,
        preservenormal=True,
        preservetopology=True,
        optimalplacement=False,
        planarquadric=False,
        planarweight=0.1,
        qualityweight=True,
    )
    after = decimate(mesh, 500, "pymeshlab_qem")
    assert np.array_equal(before.positions, after.positions)
    assert np.array_equal(before.faces, after.faces)


@pytest.mark.parametrize("offset", [0, 10_000])
def test_what_pymeshlab_refuses_is_a_rejection(offset: int) -> None:
    ball = sphere()
    faces = ball.faces + offset if offset else ball.faces[:0]
    with pytest.raises(Rejected, match="decimation_failed"):
        decimate(TriangleMesh(positions=ball.positions, faces=faces), 100, "pymeshlab_qem")


def test_clustering_stays_inside_the_box() -> None:
    mesh = prepared(knot())
    result = decimate(mesh, 200, "vertex_clustering")
    assert (result.positions >= mesh.positions.min(axis=0)).all()
    assert (result.positions <= mesh.positions.max(axis=0)).all()


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
    assert safe_method(wheel, "pymeshlab_qem") == "vertex_clustering"
    assert safe_method(pages, "pymeshlab_qem") == "vertex_clustering"
    assert safe_method(prepared(sphere()), "pymeshlab_qem") == "pymeshlab_qem"


def test_pymeshlab_has_what_we_use() -> None:
    assert missing_filters() == []


def test_a_missing_filter_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pymeshlab, "filter_list", lambda: ["compute_scalar_by_something"])
    assert missing_filters() == ["meshing_decimation_quadric_edge_collapse"]


def _moved(mesh: TriangleMesh, vertex: int, to: list[float]) -> TriangleMesh:
    positions = mesh.positions.copy()
    positions[vertex] = to
    return TriangleMesh(positions=positions, faces=mesh.faces)


@pytest.mark.parametrize(
    ("reason", "spoil"),
    [
        (
            "budget_missed",
            lambda mesh: TriangleMesh(positions=mesh.positions, faces=mesh.faces[:0]),
        ),
        ("nonfinite_result", lambda mesh: _moved(mesh, 7, [0.0, np.nan, 0.0])),
        ("bbox_escaped", lambda mesh: _moved(mesh, 7, [0.0, 0.0, 18.0])),
        (
            "error_over_bound",
            lambda mesh: TriangleMesh(positions=0.8 * mesh.positions, faces=mesh.faces),
        ),
    ],
)
def test_the_gate_names_what_is_wrong(reason: str, spoil) -> None:  # type: ignore[no-untyped-def]
    mesh = prepared(sphere())
    surface = Surface(mesh, UNIFORM)
    assert check_level(mesh, surface, len(mesh.faces), 0.03)[1] < 1e-12
    with pytest.raises(Rejected) as caught:
        check_level(spoil(mesh), surface, len(mesh.faces), 0.03)
    assert caught.value.reason == reason


def test_the_gate_counts_faces() -> None:
    mesh = prepared(sphere())
    with pytest.raises(Rejected, match="budget_missed"):
        check_level(mesh, Surface(mesh, UNIFORM), len(mesh.faces) - 1, 0.03)
