"""Cleaning is exact and forgets scale, place, order and winding; faces end up outward."""

import itertools

import numpy as np

from pipeline.assets.cleaning.clean import GRID, geometry_sha256
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.mesh import TriangleMesh
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import as_rows, cleaned, flip_some, knot, sphere, volume


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


def oriented(mesh: TriangleMesh) -> TriangleMesh:
    return orient_outward(cleaned(mesh))[0]


@for_each(("share", "mesh"), itertools.product([0.0, 0.3, 1.0], [sphere(), knot()]))
def test_flipped_faces_are_turned_back(share: float, mesh: TriangleMesh) -> None:
    right = cleaned(mesh).faces
    flipped = oriented(flip_some(mesh, share, np.random.default_rng(2)))
    assert np.array_equal(flipped.faces, right)


def test_each_of_several_bodies_is_turned_on_its_own() -> None:
    ball = sphere()
    count = len(ball.positions)
    both = TriangleMesh(
        positions=np.concatenate([ball.positions, ball.positions + 3]),
        faces=np.concatenate([ball.faces, ball.faces[:, ::-1] + count]),
    )
    mesh = oriented(both)
    centres = mesh.corners.mean(axis=1)
    middle = np.where(centres[:, :1] > 0, 1, -1) * np.abs(centres).mean(axis=0)
    outward = np.einsum("ij,ij->i", mesh.double_area_vectors, centres - middle)
    assert (outward > 0).all()


def test_a_body_that_nobody_sees_is_turned_by_its_volume() -> None:
    outer, inner = sphere(), sphere(rings=5, columns=8)
    nested = TriangleMesh(
        positions=np.concatenate([outer.positions, 0.3 * inner.positions]),
        faces=np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.positions)]),
    )
    mesh = oriented(nested)
    alone = np.linalg.norm(mesh.corners, axis=2).max(axis=1) < 0.2
    inside = TriangleMesh(positions=mesh.positions, faces=mesh.faces[alone])
    assert alone.sum() == len(inner.faces)
    assert volume(inside) > 0


def test_an_open_cup_keeps_its_outside_out() -> None:
    ball = sphere()
    below = ball.positions[ball.faces].mean(axis=1)[:, 2] < 0.2
    cup = TriangleMesh(positions=ball.positions, faces=ball.faces[below])
    right = cleaned(cup).faces
    flipped = oriented(flip_some(cup, 0.3, np.random.default_rng(3)))
    assert np.array_equal(flipped.faces, right)
