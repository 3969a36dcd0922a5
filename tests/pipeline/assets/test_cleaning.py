"""Cleaning is exact and turns faces outward; meshes of scenes stay where they are."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.cleaning.clean import GRID, geometry_sha256
from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.settings import AssetSettings
from pipeline.exchange.scene_files import load_mesh_file
from pipeline.foreign.mesh import TriangleMesh
from storage.errors import TrilightError
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import (
    as_rows,
    cleaned,
    flip_some,
    joined,
    knot,
    moved,
    sphere,
    with_faces,
    with_vertex,
    write_obj,
)

SETTINGS = AssetSettings()


def test_remeshing_keeps_size_place_and_number_and_needs_some_area(tmp_path: Path) -> None:
    mesh = moved(knot(), 3, [5, -2, 1])
    path = write_obj(tmp_path / "knot.obj", mesh)
    as_it_is = load_mesh_file(path, "knot", "knot", SETTINGS, "MIT")
    even = load_mesh_file(path, "knot", "knot", SETTINGS, "MIT", 1000)
    assert len(as_it_is.faces) == len(mesh.faces)
    assert 500 < len(even.faces) <= 1000
    for end in ("min", "max"):
        before, after = (getattr(each.positions, end)(axis=0) for each in (as_it_is, even))
        # A thousand triangles cut the corners of a tube by a few percent of its box at most.
        np.testing.assert_allclose(after, before, atol=0.03 * np.ptp(mesh.positions))
    line = TriangleMesh(
        positions=np.outer(np.arange(6.0), [1.0, 2.0, 3.0]), faces=np.array([[0, 1, 2], [3, 4, 5]])
    )
    path = write_obj(tmp_path / "line.obj", line)
    assert len(load_mesh_file(path, "line", "line", SETTINGS, "MIT").faces) == 2
    with pytest.raises(TrilightError, match="line: remesh_failed"):
        load_mesh_file(path, "line", "line", SETTINGS, "MIT", 100)


def same(a: TriangleMesh, b: TriangleMesh) -> bool:
    return np.array_equal(a.positions, b.positions) and np.array_equal(a.faces, b.faces)


def test_cleaning_centres_fits_float32_forgets_order_size_and_place_and_twice_is_once() -> None:
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


def test_a_quarter_turn_turns_the_result() -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    straight, mesh = cleaned(knot()), knot()
    turned = cleaned(TriangleMesh(positions=mesh.positions @ turn.T, faces=mesh.faces))
    assert as_rows(turned.positions, turned.faces) == as_rows(
        straight.positions @ turn.T, straight.faces
    )


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
