"""Decimation: budgets, methods, even triangles, the fewest within a bound, and watertight ones."""

import json
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.assets import watertight
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.decimation.decimate import decimate, safe_method, smallest_passing
from pipeline.assets.decimation.pymeshlab_filters import REQUIRED_FILTERS, pymeshlab
from pipeline.assets.quality.measure import Surface, level_mesh, require_watertight
from pipeline.assets.recipe import methods_of, missing_filters
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected
from storage.records.asset import Level, LevelQuality
from storage.settings.described import settings_record
from tests.command_line import trilight
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import (
    book,
    cleaned,
    cube,
    fan,
    flip_some,
    grid,
    joined,
    knot,
    moved,
    prepare,
    reason_of,
    sphere,
    with_faces,
    write_obj,
)

METHODS = methods_of("uniform")
"""All four of them."""
COLLAPSE, UNIFORM = "pymeshlab_collapse", "pymeshlab_uniform"
USED = {"meshoptimizer_sloppy": 0.5}
"""Least share of the budget that is used, where it is not 0.8: clustering moves in steps of its
grid."""


@for_each("method", METHODS)
def test_budgets_are_met_and_the_error_falls_with_them(method: str) -> None:
    mesh = cleaned(knot())
    surface, errors = Surface(mesh, np.random.default_rng(0).random((4000, 3))), []
    for budget in (1600, 800, 300):
        result = decimate(mesh, budget, method)
        # A budget is worth little if much of it stays unused.
        assert USED.get(method, 0.8) * budget <= len(result.faces) <= budget
        errors.append(surface.hausdorff_deviation(result).two_way(99))
        if method.startswith("meshoptimizer"):  # which invents no vertex
            used = set(map(tuple, result.corners.reshape(-1, 3).tolist()))
            assert used <= set(map(tuple, mesh.positions.tolist()))
    assert errors == sorted(errors)
    # Cells of clustering at 1600 faces are 1/19 of the box; vertices move by a good part of half.
    assert errors[0] < 0.02


def test_qslim_collapses_a_mesh_that_is_no_manifold() -> None:
    """libigl alone returns no face of a mesh that has an edge of three faces."""
    mesh = cleaned(knot())
    a, b = mesh.faces[0, :2]
    apex = mesh.positions.mean(axis=0, keepdims=True)
    fin = TriangleMesh(
        positions=np.concatenate([mesh.positions, apex]),
        faces=np.concatenate([mesh.faces, [[a, b, len(mesh.positions)]]]),
    )
    assert 480 <= len(decimate(fin, 600, "libigl_qslim").faces) <= 600


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


@for_each("method", [COLLAPSE, UNIFORM])
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


def test_what_pymeshlab_refuses_is_a_rejection_and_wild_meshes_are_kept_from_it() -> None:
    ball = sphere()
    none, beyond = with_faces(ball, ball.faces[:0]), with_faces(ball, ball.faces + 10_000)
    for mesh, method in ((none, COLLAPSE), (beyond, COLLAPSE), (none, UNIFORM)):
        with pytest.raises(Rejected, match="decimation_failed"):
            decimate(mesh, 100, method)
    for method in (COLLAPSE, UNIFORM):
        assert safe_method(fan(600), method) == safe_method(book(10), method) == "meshoptimizer"
        assert safe_method(cleaned(ball), method) == method
    assert safe_method(fan(600), "meshoptimizer_sloppy") == "meshoptimizer_sloppy"


def test_pymeshlab_has_what_we_use_and_a_missing_filter_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert missing_filters() == []
    monkeypatch.setattr(pymeshlab, "filter_list", lambda: ["compute_scalar_by_something"])
    assert missing_filters() == list(REQUIRED_FILTERS)


def counted(passes: Callable[[int], bool]) -> tuple[Callable[[int], int], list[int]]:
    """Return an attempt that returns its budget where that passes, and the budgets it was given."""
    tried: list[int] = []

    def attempt(budget: int) -> int:
        tried.append(budget)
        if not passes(budget):
            raise Rejected("error_over_bound", "too coarse")
        return budget

    return attempt, tried


@given(largest=st.integers(1, 1_000_000), share=st.floats(0, 1))
def test_a_monotone_error_is_met_within_nine_percent(largest: int, share: float) -> None:
    fewest = max(min(largest, 4), round(largest * share))
    attempt, tried = counted(lambda budget: budget >= fewest)
    found = smallest_passing(attempt, largest)
    # A rung is 2^(1/8) = 1.0905 times the next, and each is rounded to a whole number.
    assert fewest <= found <= 1.091 * fewest + 1
    # 144 rungs from a million to 4 take eight halvings, after the largest itself.
    assert len(tried) <= 9
    assert len(tried) == len(set(tried))


@given(largest=st.integers(4, 5000), passing=st.sets(st.integers(4, 5000)))
def test_whatever_comes_back_has_passed_and_only_failures_are_searched_below(
    largest: int, passing: set[int]
) -> None:
    attempt, tried = counted(lambda budget: budget == largest or budget in passing)
    found = smallest_passing(attempt, largest)
    assert found == largest or found in passing
    assert 4 <= min(tried)
    assert max(tried) == largest == tried[0]
    attempt, tried = counted(lambda budget: False)
    with pytest.raises(Rejected, match="error_over_bound"):
        smallest_passing(attempt, largest)
    assert tried == [largest]

    def broken(budget: int) -> int:
        if budget < largest:
            raise MemoryError
        return budget

    if largest > 4:
        with pytest.raises(MemoryError):
            smallest_passing(broken, largest)


BUDGET = 1400


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_obj(tmp_path_factory.mktemp("knot") / "knot.obj", knot())


@cache
def finest(path: Path, epsilon: float | None, budgets: tuple[int, ...] = (BUDGET,)) -> Level:
    return prepare(path, AssetSettings(budgets=budgets, epsilon=epsilon)).levels[0]


def test_the_bound_is_kept_and_the_next_smaller_budget_breaks_it(path: Path) -> None:
    rungs = [round(BUDGET / 2 ** (k / 8)) for k in range(80)]  # the budgets that the search knows
    for epsilon in (0.003, 0.01):
        level = finest(path, epsilon)
        assert level.record.budget == BUDGET
        assert level.record.quality.error_p99 <= epsilon
        smaller = finest(path, None, (max(rung for rung in rungs if rung < len(level.faces)),))
        assert len(smaller.faces) < len(level.faces)
        assert smaller.record.quality.error_p99 > epsilon


def test_looser_bounds_take_no_more_faces_and_what_cannot_be_met_takes_all(path: Path) -> None:
    sizes = [len(finest(path, epsilon).faces) for epsilon in (0.001, 0.003, 0.01, 0.03)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.2 * sizes[0]
    level = finest(path, 1e-5)
    # Edges take two faces each: the collapse stops at most one short.
    assert BUDGET - 1 <= len(level.faces) <= BUDGET
    assert level.record.quality.error_p99 > 1e-5
    # Coarser levels keep their budgets, and one that the finest already meets is left out.
    levels = prepare(path, AssetSettings(epsilon=0.01)).levels
    assert [level.record.budget for level in levels] == [1400, 340, 240]
    assert 340 < len(levels[0].faces) <= 500


def test_the_gate_holds_whatever_epsilon_allows(path: Path) -> None:
    """Normals decide here: with and without their limit, the distance allows the same."""
    strict = GateSettings(max_normal_error_deg=11.0)
    loose = finest(path, 0.01)
    tight = prepare(path, AssetSettings(budgets=(BUDGET,), epsilon=0.01, gate=strict)).levels[0]
    assert loose.record.quality.normal_error_deg > 11.0 >= tight.record.quality.normal_error_deg
    assert len(tight.faces) > len(loose.faces)


CUBOID = moved(cube(8), [1, 0.7, 0.4])


@for_each("mesh, most", [(CUBOID, 24), (grid(20), 16)])
def test_flat_parts_cost_next_to_nothing(tmp_path: Path, mesh: TriangleMesh, most: int) -> None:
    """Also of an object that is within the budget as it is."""
    path = write_obj(tmp_path / "flat.obj", mesh)
    level = finest(path, 0.005)
    assert len(level.faces) <= most
    assert level.record.quality.error_p99 <= 0.005
    assert finest(path, None).record.method == "source"


def quality(path: Path, method: str) -> LevelQuality:
    profile = "uniform" if method == UNIFORM else "faithful"
    settings = AssetSettings(profile=profile, budgets=(1000,))  # type: ignore[arg-type]
    (level,) = prepare(path, settings, method).levels
    assert level.record.method == method
    return level.record.quality


@for_each(
    "mesh, variation, angle",
    # Rings crowd at the poles of a sphere: far from even as it is. The coarse knot has many edges
    # sharper than the features that remeshing keeps.
    [(moved(sphere(rings=61, columns=80), [1.0, 1.0, 0.5]), 0.5, 1.5), (knot(), 0.9, 1.2)],
)
def test_triangles_are_more_even_than_the_faithful_ones(
    tmp_path: Path, mesh: TriangleMesh, variation: float, angle: float
) -> None:
    """Measured 0.16 and 0.31 against 0.56 and 0.42; and 40 and 23 against 19 and 14.5.

    Evenness is paid for with error.
    """
    path = write_obj(tmp_path / "a.obj", mesh)
    even, faithful = quality(path, UNIFORM), quality(path, COLLAPSE)
    assert even.area_variation < variation * faithful.area_variation
    assert even.min_angle_p5_deg > angle * faithful.min_angle_p5_deg
    assert faithful.error_p99 < even.error_p99 <= 0.03


def test_a_coarse_box_gains_triangles(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "a.obj", moved(cube(), [1, 0.7, 0.4]))
    settings = AssetSettings(profile="uniform", budgets=(1000, 240))
    for level in prepare(path, settings, UNIFORM).levels:
        assert level.record.method == UNIFORM
        # Remeshing aims at most of the budget, and meets the edge length only roughly.
        assert 0.5 * level.record.budget < len(level.faces) <= level.record.budget
        # A plane stays a plane: distances are double precision, of points on the 2^-20 grid.
        assert level.record.quality.error_p99 < 2**-20
        assert level.record.quality.area_variation < 0.4
        assert level.record.quality.min_angle_p5_deg > 25


METHOD = methods_of("faithful", watertight=True)[0]
WATERTIGHT = AssetSettings(budgets=(1400, 240), watertight=True)
CELLS = 24
"""Of the grid, instead of 128: the laws are those of any grid, and hundreds of nodes are quick."""


@pytest.fixture(autouse=True, scope="module")
def _coarse_grid() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(watertight, "_CELLS", CELLS)
        yield


def is_watertight(mesh: TriangleMesh) -> bool:
    """As trimesh judges it, after it has merged equal positions; and each vertex has one fan."""
    other = trimesh.Trimesh(mesh.positions, mesh.faces)
    if not (other.is_watertight and other.is_winding_consistent and other.volume > 0):
        return False
    # the edges opposite a vertex, between its neighbours, must be one closed walk around it
    corners = np.concatenate([np.roll(other.faces, step, axis=1) for step in range(3)])
    beside = corners[:, :1] * len(other.vertices) + corners[:, 1:]
    pairs, ends = np.unique(beside, return_inverse=True)
    labels = trimesh.graph.connected_component_labels(ends.reshape(-1, 2), len(pairs))
    return bool(labels.max() + 1 == len(np.unique(other.faces)))


def pierced(mesh: TriangleMesh, *, faces: int) -> TriangleMesh:
    return with_faces(mesh, mesh.faces[faces:])


BALL = sphere(rings=12, columns=24)
TOUCHING = joined(moved(cube(), 0.5, -0.25), moved(cube(), 0.5, 0.25))
CROSSING = joined(cube(2), moved(cube(2), [0.3, 0.3, 1.4]))
SHAPES = {
    "sphere": sphere(rings=8, columns=12),
    "knot": knot(segments=40),
    "sheet": grid(4),
    "bowl": pierced(BALL, faces=len(BALL.faces) // 2),
    "book": book(5),
    "touching": TOUCHING,
    "nested": joined(cube(2), moved(cube(2), 0.4)),
    "crossing": CROSSING,
}


@st.composite
def spoiled(draw: st.DrawFn) -> TriangleMesh:
    """A shape that may be open, self-intersecting, doubled, and flipped in part."""
    mesh = SHAPES[draw(st.sampled_from(sorted(SHAPES)))]
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    if draw(st.booleans(), "open"):
        mesh = with_faces(mesh, mesh.faces[rng.random(len(mesh.faces)) < 0.8])
    if draw(st.booleans(), "self-intersecting"):
        mesh = joined(mesh, moved(mesh, 0.7, rng.normal(0, 0.1, 3)))
    if draw(st.booleans(), "doubled"):
        mesh = joined(mesh, with_faces(mesh, mesh.faces[:, ::-1]), moved(mesh, 1, 1e-5))
    return flip_some(mesh, draw(st.sampled_from((0.0, 0.3, 1.0))), rng)


@settings(max_examples=25)
@given(mesh=spoiled(), fills=st.booleans())
def test_a_surface_around_anything_is_closed_oriented_and_manifold(
    mesh: TriangleMesh, fills: bool
) -> None:
    source = cleaned(mesh)
    around = watertight.surface_around(source, fills=fills)
    require_watertight(around)
    assert is_watertight(around)
    squared = igl.point_mesh_squared_distance(around.positions, source.positions, source.faces)[0]
    # a quarter of a cell where distances are linear; between crowded triangles they are not
    assert 0 < squared.min() and np.sqrt(np.median(squared)) < 0.27 / CELLS
    assert np.sqrt(squared.max()) < 0.5 / CELLS


@for_each(
    "name, mesh, method",
    [
        ("closed already", BALL, "source"),
        ("two of its triangles away", pierced(BALL, faces=2), f"capped {METHOD}"),
        ("flipped", flip_some(BALL, 0.5, np.random.default_rng(1)), "source"),
        ("doubled", joined(BALL, with_faces(BALL, BALL.faces[:, ::-1])), "source"),
        ("crossing itself, closed", CROSSING, "source"),
        ("touching at a corner", TOUCHING, f"solid {METHOD}"),
        ("open", SHAPES["bowl"], f"solid {METHOD}"),
    ],
)
def test_levels_are_watertight_and_near_the_source(
    name: str, mesh: TriangleMesh, method: str, tmp_path: Path
) -> None:
    asset = prepare(write_obj(tmp_path / "a.obj", mesh), WATERTIGHT, METHOD)
    assert asset.levels[0].record.method == method, name
    surface = Surface(orient_outward(cleaned(mesh))[0], np.random.default_rng(9).random((8192, 3)))
    for level in asset.levels:
        quality = level.record.quality
        assert is_watertight(level_mesh(level)) and quality.open_edges == 0
        assert len(level.faces) <= level.record.budget
        other = surface.hausdorff_deviation(level_mesh(level)).two_way(98.6)
        assert other <= quality.error_p99 + 1e-14
        assert quality.error_p99 <= WATERTIGHT.gate.max_error_p99


def test_what_cannot_be_had_is_refused_with_the_reason(tmp_path: Path) -> None:
    # a cube in a cube, which a solid one would lose, and a sheet above them
    walled = joined(SHAPES["nested"], moved(grid(2), 1, [0, 0, 0.8]))
    path = write_obj(tmp_path / "a.obj", walled)
    assert prepare(path, WATERTIGHT, METHOD).levels[0].record.method == f"hollow {METHOD}"
    strict = AssetSettings(budgets=(1400,), watertight=True, gate=GateSettings(max_error_p99=1e-4))
    assert reason_of(path, strict, METHOD) == "error_over_bound"
    with pytest.raises(Rejected, match="made watertight: p99 distance .* expected <= 0.01%"):
        prepare(path, strict, METHOD)
    with pytest.raises(Rejected, match="0 edges without .*, 1 vertices where surfaces") as refusal:
        require_watertight(cleaned(TOUCHING))
    assert refusal.value.reason == "not_watertight"
    with pytest.raises(Rejected, match="3 edges without a second triangle"):
        require_watertight(cleaned(pierced(BALL, faces=1)))


def test_the_command_and_the_record(tmp_path: Path) -> None:
    assert "watertight" not in settings_record(AssetSettings())
    assert settings_record(WATERTIGHT)["watertight"] is True
    (tmp_path / "in").mkdir()
    write_obj(tmp_path / "in/a.obj", pierced(BALL, faces=2))
    words = ["assets", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--json"]
    result = trilight([*words, "--watertight", "--budget", "200"])
    assert result.exit_code == 0, result.exception
    (row,) = json.loads(result.stdout)["objects"]
    assert (row["method"], row["quality"]["open_edges"]) == (f"capped {METHOD}", 0)
    assert not row["source"]["watertight"]
    assert trimesh.load_mesh(tmp_path / "out" / row["path"]).is_watertight
