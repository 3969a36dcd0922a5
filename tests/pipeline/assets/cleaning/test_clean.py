"""Cleaning is exact: it forgets scale, place and order, and keeps every real triangle."""

import itertools

import numpy as np

from pipeline.assets.cleaning.clean import GRID, geometry_sha256
from pipeline.assets.mesh import TriangleMesh
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import as_rows, cleaned, knot, sphere


def same(a: TriangleMesh, b: TriangleMesh) -> bool:
    return np.array_equal(a.positions, b.positions) and np.array_equal(a.faces, b.faces)


def test_the_box_is_centred_and_its_longest_side_is_one() -> None:
    result = cleaned(knot())
    low, high = result.positions.min(axis=0), result.positions.max(axis=0)
    # Each end is rounded to the grid on its own.
    np.testing.assert_allclose(low + high, 0, atol=1 / GRID)
    assert (high - low).max() == 1


def test_positions_survive_float32() -> None:
    positions = cleaned(knot()).positions
    assert np.array_equal(positions.astype(np.float32).astype(np.float64), positions)


@for_each(("scale", "offset"), itertools.product([1e-6, 0.37, 4.0, 1e7], [0.0, 12.3]))
def test_scale_and_offset_are_forgotten(scale: float, offset: float) -> None:
    mesh = knot()
    moved = TriangleMesh(positions=(mesh.positions + offset) * scale, faces=mesh.faces)
    assert same(cleaned(moved), cleaned(mesh))


def test_order_of_vertices_and_faces_is_forgotten() -> None:
    mesh, rng = knot(), np.random.default_rng(1)
    order = rng.permutation(len(mesh.positions))
    faces = np.argsort(order)[mesh.faces][rng.permutation(len(mesh.faces))]
    turned = np.take_along_axis(faces, (rng.integers(0, 3, (len(faces), 1)) + np.arange(3)) % 3, 1)
    shuffled = TriangleMesh(positions=mesh.positions[order], faces=turned)
    assert same(cleaned(shuffled), cleaned(mesh))


def test_a_quarter_turn_turns_the_result() -> None:
    mesh = knot()
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = cleaned(TriangleMesh(positions=mesh.positions @ turn.T, faces=mesh.faces))
    straight = cleaned(mesh)
    assert as_rows(turned.positions, turned.faces) == as_rows(
        straight.positions @ turn.T, straight.faces
    )


def test_cleaning_twice_changes_nothing() -> None:
    once = cleaned(sphere())
    assert same(cleaned(once), once)


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
    result = cleaned(dirty)
    assert len(result.positions) == len(mesh.positions)
    assert as_rows(result.positions, result.faces) == as_rows(*_arrays(cleaned(mesh)))


def test_the_digest_forgets_winding_order_and_scale_but_not_shape() -> None:
    mesh = knot()
    digest = geometry_sha256(cleaned(mesh))
    copies = [
        TriangleMesh(positions=mesh.positions * 3.7, faces=mesh.faces[::-1]),
        TriangleMesh(positions=mesh.positions, faces=mesh.faces[:, ::-1]),
    ]
    assert {geometry_sha256(cleaned(copy)) for copy in copies} == {digest}
    others = [sphere(), knot(segments=161), _moved_vertex(mesh, 1e-3)]
    assert digest not in {geometry_sha256(cleaned(other)) for other in others}


def _moved_vertex(mesh: TriangleMesh, distance: float) -> TriangleMesh:
    positions = mesh.positions.copy()
    positions[17, 2] += distance
    return TriangleMesh(positions=positions, faces=mesh.faces)


def _arrays(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.positions, mesh.faces
