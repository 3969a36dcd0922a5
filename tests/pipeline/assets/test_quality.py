"""Cleaning is exact and turns faces outward; measures and the gate that refuses by name."""

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.assets.cleaning.clean import GRID, geometry_sha256
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.quality.measure import (
    MeasuredSource,
    Surface,
    area_variation,
    check_level,
    faces_of_edges,
    intersection_over_union,
    sample_surface,
    silhouette,
    smallest_angles_deg,
)
from pipeline.assets.settings import AssetSettings, GateSettings
from pipeline.exchange.scene_files import load_mesh_file
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import Rejected, TrilightError
from storage.records.asset import LevelQuality
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import (
    as_rows,
    book,
    cleaned,
    cube,
    flip_some,
    grid,
    joined,
    knot,
    moved,
    sphere,
    with_faces,
    with_vertex,
    write_obj,
)

Spoil = Callable[[TriangleMesh], TriangleMesh]


def gate(
    source: TriangleMesh, result: TriangleMesh, **limits: float
) -> tuple[TriangleMesh, LevelQuality]:
    settings = GateSettings(**limits)  # type: ignore[arg-type]
    faces = len(result.faces)
    return check_level(result, MeasuredSource(source), faces, settings, settings.max_error_p99)


def some_faces(mesh: TriangleMesh, count: int) -> TriangleMesh:
    return with_faces(mesh, mesh.faces[:count])


def sheet(slope_deg: float, cells: int = 60) -> TriangleMesh:
    """A unit square, corrugated: rows go up and down by the slope, in folds a cell wide."""
    flat = grid(cells)
    rows = np.arange(len(flat.positions)) // (cells + 1) % 2
    height = np.tan(np.radians(slope_deg)) / cells * rows
    return moved(flat, 1.0, np.outer(height, [0, 0, 1]))


def round_ball() -> TriangleMesh:
    return cleaned(moved(sphere(31, 48), [1, 1 / 0.8, 1 / 0.6]))


def rod() -> TriangleMesh:
    """As long as the box and a fortieth as thick."""
    return cleaned(moved(sphere(rings=31, columns=24), [1.0, 0.025 / 0.8, 0.025 / 0.6]))


def specked_ball() -> TriangleMesh:
    """A ball with sixteen dust grains that are 2 % of its area, a hundredth away from it."""
    turn = np.arange(16) * np.pi / 8
    places = 0.52 * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(16)])
    return joined(round_ball(), *(moved(cube(), 0.026, place) for place in places))


BALL = cleaned(sphere())

SPOILT: dict[str, tuple[str, TriangleMesh, Spoil, dict[str, float]]] = {
    "nothing left": ("budget_missed", BALL, lambda mesh: some_faces(mesh, 0), {}),
    "not a number": ("nonfinite_result", BALL, lambda mesh: with_vertex(mesh, [0, np.nan, 0]), {}),
    "flung": ("bbox_escaped", BALL, lambda mesh: with_vertex(mesh, [0, 0, 18]), {}),
    "half": ("area_changed", BALL, lambda mesh: some_faces(mesh, len(mesh.faces) // 2), {}),
    "doubled": ("area_changed", BALL, lambda mesh: joined(mesh, moved(mesh, 0.999)), {}),
    "shrunk": ("error_over_bound", BALL, lambda mesh: moved(mesh, 0.89), {}),
    "folded": (
        "normals_changed", sheet(0), lambda mesh: sheet(36.5), {"max_normal_error_deg": 90.0},
    ),
    "beside": (
        "silhouette_changed", rod(), lambda mesh: moved(mesh, 1.0, [0, 0.009, 0]),
        {"min_silhouette_iou": 0.01},
    ),
    "dusted": (
        "parts_lost", specked_ball(), lambda mesh: some_faces(mesh, 2976), {"max_lost_area": 1.0},
    ),
}  # fmt: skip
"""Reason, source, what becomes of it, and the limit that alone refuses it."""


@for_each("name", SPOILT)
def test_the_gate_names_what_is_wrong(name: str) -> None:
    reason, source, spoil, lifted = SPOILT[name]
    with pytest.raises(Rejected) as caught:
        gate(source, spoil(source))
    assert caught.value.reason == reason
    assert caught.value.message.isprintable()
    if lifted:
        gate(source, spoil(source), **lifted)


@for_each("side, axis", itertools.product([-1, 1], [0, 1, 2]))
def test_a_vertex_may_leave_the_box_by_one_percent(side: int, axis: int) -> None:
    """Of the diagonal: rounded shapes bulge a little when their vertices are placed freely."""
    end = int(np.argmax(side * BALL.positions[:, axis]))

    def pulled(share: float) -> TriangleMesh:
        step = side * share * BALL.diagonal * np.eye(3)[axis]
        return with_vertex(BALL, BALL.positions[end] + step, row=end)

    gate(BALL, pulled(0.009))
    with pytest.raises(Rejected, match="bbox_escaped"):
        gate(BALL, pulled(0.011))


def test_the_gate_counts_faces_that_do_not_collapse_on_the_grid() -> None:
    settings = GateSettings()
    with pytest.raises(Rejected, match=f"budget_missed: {len(BALL.faces)} faces"):
        check_level(BALL, MeasuredSource(BALL), len(BALL.faces) - 1, settings, 0.03)
    # The result is cleaned before it is counted: a needle is no triangle.
    dirty = with_faces(BALL, np.concatenate([BALL.faces, [[0, 0, 1], [5, 5, 5]]]))
    mesh, _ = check_level(dirty, MeasuredSource(BALL), len(BALL.faces), settings, 0.03)
    assert len(mesh.faces) == len(BALL.faces)


def test_a_level_that_is_its_source_has_nothing_to_regret() -> None:
    mesh, quality = gate(cleaned(knot()), cleaned(knot()))
    assert len(mesh.faces) == len(knot().faces)
    # Distances of a point to the face it lies on, and areas added in the same order.
    assert quality.error_max < 1e-14
    assert (quality.area_ratio, quality.silhouette_iou, quality.lost_area) == (1, 1, 0)
    # The arc cosine turns a rounding of 1e-16 next to 1 into 1e-8 radians.
    assert quality.normal_error_deg < 1e-4
    assert quality.open_edges == 0


FEWER = np.random.default_rng(0).random((4000, 3))


def p99(mesh: TriangleMesh, other: TriangleMesh) -> float:
    return Surface(mesh, FEWER).hausdorff_deviation(other).two_way(99)


def test_distances_count_both_ways_at_any_scale_as_in_another_program() -> None:
    square = moved(grid(1), 1.0, 0.5)
    for height in (0.01, 0.25):
        above = moved(square, 1.0, [0, 0, height])
        assert p99(square, above) == pytest.approx(height / np.sqrt(2), rel=1e-9)
    large = moved(square, 1.5)
    # From the large square, the farthest one percent lies near the corner sqrt(0.5) away.
    from_small = p99(square, large) * np.sqrt(2)
    from_large = p99(large, square) * np.sqrt(4.5)
    assert 0.5 < from_small < np.sqrt(0.5)
    assert from_large == pytest.approx(from_small, rel=1e-9)
    mesh, other = knot(), knot(segments=40)
    error = p99(mesh, other)
    assert p99(moved(mesh, 8), moved(other, 8)) == pytest.approx(error, rel=1e-12)
    mesh, other = sphere(rings=5, columns=8), knot(segments=12, sides=4)
    fast = Surface(mesh, FEWER[:40]).hausdorff_deviation(other).to_other
    points = sample_surface(mesh, FEWER[:40])[0]
    other_program = trimesh.Trimesh(other.positions, other.faces, process=False)
    slow = trimesh.proximity.closest_point_naive(other_program, points)[1] / mesh.diagonal
    np.testing.assert_allclose(fast, slow, atol=1e-12)


def test_samples_fall_on_faces_by_area_and_fill_them_evenly() -> None:
    mesh = knot()
    shares = np.linalg.norm(mesh.double_area_vectors, axis=1)
    upper = mesh.corners[:, :, 2].mean(axis=1) > 0
    points = sample_surface(mesh, FEWER)[0]
    expected = shares[upper].sum() / shares.sum()
    # Stratified by area: the share is exact to the faces that the plane cuts, about one in fifty.
    assert (points[:, 2] > 0).mean() == pytest.approx(expected, abs=0.02)
    triangle = TriangleMesh(positions=np.diag([1.0, 2.0, 3.0]), faces=np.array([[0, 1, 2]]))
    weights = sample_surface(triangle, FEWER)[0] / [1, 2, 3]
    # Barycentric coordinates of even points: mean 1/3, variance 1/18, covariance -1/36. Of 4000
    # points the mean is known to 0.004 and the variance to about 2 % (one sigma); 4 sigma allowed.
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 3, atol=0.015)
    np.testing.assert_allclose(np.cov(weights.T), (np.eye(3) / 12 - 1 / 36), atol=0.08 / 18)


MESHES: dict[str, tuple[TriangleMesh, tuple[int, int, int]]] = {
    "knot": (knot(20, 6), (0, 0, 2)),
    "cube": (cube(2), (48, 0, 2)),
    "book": (book(3), (6, 1, 3)),
    "sheet": (sheet(30.0, cells=6), (24, 0, 2)),
}
"""Meshes, with their open and non-manifold edges and the most faces of one edge."""


@for_each("name", MESHES)
def test_angles_and_areas_are_those_of_another_program_and_edges_are_counted(name: str) -> None:
    mesh, expected = MESHES[name]
    other = trimesh.Trimesh(mesh.positions, mesh.faces, process=False)
    slow = np.degrees(other.face_angles.min(axis=1))
    np.testing.assert_allclose(smallest_angles_deg(mesh), slow, rtol=1e-9)  # double precision
    variation = other.area_faces.std() / other.area_faces.mean()
    assert area_variation(mesh) == pytest.approx(variation, rel=1e-6, abs=1e-7)
    shared = faces_of_edges(mesh)
    assert ((shared == 1).sum(), (shared > 2).sum(), shared.max()) == expected


def test_outlines_are_halves_and_discs_as_counted_by_hand() -> None:
    whole = sheet(0.0)
    half = some_faces(whole, len(whole.faces) // 2)
    agreement = intersection_over_union(silhouette(whole), silhouette(half))
    # 8 bundles of rays 2.8 % apart: the cut goes between rows of about 35, on either side of it.
    assert agreement == pytest.approx(0.5, abs=0.02)
    assert intersection_over_union(silhouette(half), silhouette(whole)) == agreement
    assert intersection_over_union(silhouette(whole), silhouette(whole)) == 1
    ball = moved(sphere(61, 96), [0.5, 0.5 / 0.8, 0.5 / 0.6])
    # A disc of radius 0.5 in a bundle 1.8 wide; 64 x 64 rays count it to about one row in 35.
    assert silhouette(ball).mean() == pytest.approx(np.pi * 0.25 / 1.8**2, rel=0.03)


def with_grain(share: float) -> tuple[TriangleMesh, TriangleMesh]:
    """A ball, and the same with a cube beside it that holds a share of its area."""
    ball = round_ball()
    area = 0.5 * float(np.linalg.norm(ball.double_area_vectors, axis=1).sum())
    side = np.sqrt(share * area / 6)
    return ball, joined(ball, moved(cube(), side, [0.7, 0, 0]))


def test_a_part_that_vanishes_is_named_lost_and_one_that_is_coarser_is_not() -> None:
    ball, both = with_grain(0.005)
    quality = MeasuredSource(both).quality(ball)
    assert quality.error_p99 < 1e-6
    assert quality.error_max > 0.1
    # One point in 8192 more or less: the sample is stratified by area.
    assert quality.lost_area == pytest.approx(0.005 / 1.005, abs=3 / 8192)
    assert MeasuredSource(both).quality(both).lost_area == 0
    ball, both = with_grain(0.02)
    quality = MeasuredSource(both).quality(joined(ball, moved(cube(), 0.095, [0.705, 0, 0])))
    assert quality.error_max > 0 == quality.lost_area
    three = cleaned(joined(knot(20, 6), moved(cube(), 1, 5), moved(cube(), 1, -5)))
    assert MeasuredSource(three).num_components == 3


@for_each("slope_deg", [10.0, 30.0, 45.0])
def test_normals_of_a_corrugated_sheet_are_off_by_its_slope(slope_deg: float) -> None:
    quality = MeasuredSource(sheet(slope_deg)).quality(sheet(0.0))
    # Every face has the slope exactly; tan and arccos in double precision, stored with six digits.
    assert quality.normal_error_deg == pytest.approx(slope_deg, rel=1e-5)
    assert quality.area_ratio == pytest.approx(np.cos(np.radians(slope_deg)), rel=1e-5)


def test_remeshing_needs_some_area(tmp_path: Path) -> None:
    line = TriangleMesh(
        positions=np.outer(np.arange(6.0), [1.0, 2.0, 3.0]), faces=np.array([[0, 1, 2], [3, 4, 5]])
    )
    asked = (write_obj(tmp_path / "line.obj", line), "line", "line", AssetSettings(), "MIT")
    assert len(load_mesh_file(*asked).faces) == 2
    with pytest.raises(TrilightError, match="line: remesh_failed"):
        load_mesh_file(*asked, 100)


def same(a: TriangleMesh, b: TriangleMesh) -> bool:
    return np.array_equal(a.positions, b.positions) and np.array_equal(a.faces, b.faces)


def test_cleaning_centres_fits_float32_forgets_order_size_and_place_and_twice_is_once() -> None:
    """And a quarter turn turns the result."""
    mesh, rng = knot(), np.random.default_rng(1)
    result = cleaned(mesh)
    low, high = result.positions.min(axis=0), result.positions.max(axis=0)
    # Each end is rounded to the grid on its own.
    np.testing.assert_allclose(low + high, 0, atol=1 / GRID)
    assert (high - low).max() == 1
    assert np.array_equal(result.positions.astype(np.float32).astype(float), result.positions)
    order = rng.permutation(len(mesh.positions))
    faces = np.argsort(order)[mesh.faces][rng.permutation(len(mesh.faces))]
    turned = np.take_along_axis(faces, (rng.integers(0, 3, (len(faces), 1)) + np.arange(3)) % 3, 1)
    assert same(cleaned(TriangleMesh(positions=mesh.positions[order], faces=turned)), result)
    for scale, offset in itertools.product([1e-6, 0.37, 1e7], [0.0, 12.3]):
        assert same(cleaned(moved(mesh, scale, offset * scale)), result), (scale, offset)
    once = cleaned(sphere())
    assert same(cleaned(once), once)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    other = cleaned(TriangleMesh(positions=mesh.positions @ quarter.T, faces=mesh.faces))
    expected = as_rows(result.positions @ quarter.T, result.faces)
    assert as_rows(other.positions, other.faces) == expected


def test_soup_is_welded_and_what_is_no_triangle_is_dropped() -> None:
    mesh = sphere()
    soup = mesh.corners.reshape(-1, 3)
    corners = np.arange(len(soup)).reshape(-1, 3)
    junk = [corners[:5], corners[7:9, ::-1], corners[:4, [0, 0, 1]]]
    on_a_line = np.array([[len(soup), len(soup) + 1, len(soup) + 2]])
    line = np.array([[0.0, 0, 0], [0.1, 0.1, 0.1], [0.2, 0.2, 0.2]])
    dirty = TriangleMesh(
        positions=np.concatenate([soup, line, [[0.5, 0.5, 0.5]]]),
        faces=np.concatenate([corners, *junk, on_a_line]),
    )
    result, wanted = cleaned(dirty), cleaned(mesh)
    assert len(result.positions) == len(mesh.positions)
    assert as_rows(result.positions, result.faces) == as_rows(wanted.positions, wanted.faces)


def test_the_digest_forgets_winding_order_and_scale_but_not_shape() -> None:
    mesh = knot()
    digest = geometry_sha256(cleaned(mesh))
    copies = [
        with_faces(moved(mesh, 3.7), mesh.faces[::-1]),
        with_faces(mesh, mesh.faces[:, ::-1]),
    ]
    assert {geometry_sha256(cleaned(copy)) for copy in copies} == {digest}
    nudged = with_vertex(mesh, mesh.positions[17] + [0, 0, 1e-3], row=17)
    others = [sphere(), knot(segments=161), nudged]
    assert digest not in {geometry_sha256(cleaned(other)) for other in others}


def oriented(mesh: TriangleMesh) -> TriangleMesh:
    return orient_outward(cleaned(mesh))[0]


def open_cup() -> TriangleMesh:
    ball = sphere()
    return with_faces(ball, ball.faces[ball.corners.mean(axis=1)[:, 2] < 0.2])


@for_each("share, mesh", itertools.product([0.0, 0.3, 1.0], [sphere(), knot(), open_cup()]))
def test_flipped_faces_are_turned_back(share: float, mesh: TriangleMesh) -> None:
    if share == 1 and len(mesh.faces) == len(open_cup().faces):
        return  # an open sheet has no outside but that which most of its faces have
    flipped = oriented(flip_some(mesh, share, np.random.default_rng(2)))
    assert np.array_equal(flipped.faces, cleaned(mesh).faces)


def test_each_body_is_turned_on_its_own_and_a_hidden_one_by_its_volume() -> None:
    ball, small = sphere(), sphere(rings=5, columns=8)
    inside_out = with_faces(ball, ball.faces[:, ::-1])
    mesh = oriented(joined(ball, moved(inside_out, 1, 3)))
    centres = mesh.corners.mean(axis=1)
    middle = np.where(centres[:, :1] > 0, 1, -1) * np.abs(centres).mean(axis=0)
    assert (np.einsum("ij,ij->i", mesh.double_area_vectors, centres - middle) > 0).all()
    mesh = oriented(joined(ball, moved(with_faces(small, small.faces[:, ::-1]), 0.3)))
    hidden = mesh.corners[np.linalg.norm(mesh.corners, axis=2).max(axis=1) < 0.2]
    assert len(hidden) == len(small.faces)
    assert np.linalg.det(hidden).sum() > 0  # six times its volume
