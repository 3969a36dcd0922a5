"""Whatever the windings were, faces end up counter-clockwise from outside."""

import itertools

import numpy as np

from pipeline.assets.cleaning.orient import orient_outward
from pipeline.assets.mesh import TriangleMesh
from tests.for_each import for_each
from tests.pipeline.assets.meshes_by_hand import cleaned, flip_some, knot, sphere, volume


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
