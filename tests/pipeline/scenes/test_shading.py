"""Laws of shading normals and groups."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.scenes.shading import (
    ShadedMesh,
    face_normals,
    flat_shaded,
    shading_groups,
    smooth_shaded,
)
from scene_templates.rotations import rotation_xyz

ROUNDING = 1e-6
"""Unit vectors in float32 (6e-8 per entry) from positions in float32."""


def _arrays(mesh: trimesh.Trimesh) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)


def _shapes() -> list[tuple[NDArray[np.float32], NDArray[np.uint32]]]:
    create = trimesh.creation
    shapes = [create.icosphere(2), create.box(), create.cylinder(0.3, 1, sections=20)]
    shapes += [create.cone(0.5, 1, sections=9), create.torus(0.5, 0.2, 12, 8), create.capsule()]
    rng = np.random.default_rng(0)
    bumpy = create.icosphere(2)
    bumpy.vertices += rng.normal(scale=0.08, size=bumpy.vertices.shape)
    return [_arrays(mesh) for mesh in [*shapes, bumpy]]


def _by_corner(mesh: ShadedMesh) -> NDArray[np.float32]:
    return mesh.normals[mesh.faces]


def test_shading_moves_no_triangle_and_flat_normals_are_the_geometric_ones() -> None:
    for positions, faces in _shapes():
        for mesh in (flat_shaded(positions, faces), smooth_shaded(positions, faces, 30.0)):
            assert np.array_equal(mesh.positions[mesh.faces], positions[faces])
            assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < ROUNDING
            assert set(mesh.faces.ravel().tolist()) == set(range(len(mesh.positions)))
    for positions, faces in _shapes():
        mesh = flat_shaded(positions, faces)
        geometric = face_normals(positions, faces)
        assert np.abs(_by_corner(mesh) - geometric[:, None]).max() < ROUNDING
        assert len(mesh.positions) == 3 * len(faces)
    for positions, faces in _shapes():
        smooth = _by_corner(smooth_shaded(positions, faces, 0.0))
        flat = _by_corner(flat_shaded(positions, faces))
        # Coplanar means a cosine of at least 1 in float64: within 2e-8 radians of each other.
        assert np.abs(smooth - flat).max() < ROUNDING


def test_a_cube_keeps_its_edges_and_a_sphere_becomes_round() -> None:
    positions, faces = _arrays(trimesh.creation.box())
    cube = smooth_shaded(positions, faces, 30.0)
    assert len(cube.positions) == 24
    assert len(set(cube.groups.tolist())) == 6
    assert np.abs(np.abs(cube.normals).max(axis=1) - 1).max() < ROUNDING
    positions, faces = _arrays(trimesh.creation.icosphere(3))
    ball = smooth_shaded(positions, faces, 30.0)
    assert len(ball.positions) == len(positions)
    assert set(ball.groups.tolist()) == {0}
    # The triangles of an icosphere are 9 degrees wide and nearly even about each vertex.
    assert np.sum(ball.normals * ball.positions, axis=1).min() > np.cos(np.radians(1))


def test_groups_agree_with_a_slow_twin() -> None:
    for positions, faces in _shapes():
        normals = face_normals(positions, faces)
        for angle_deg in (10.0, 30.0, 60.0):
            groups = shading_groups(faces, normals, angle_deg)
            twin = _slow_groups(faces, normals, angle_deg)
            pairs = set(zip(groups.tolist(), twin, strict=True))
            assert len(pairs) == len(set(twin)) == len(set(groups.tolist()))


def _slow_groups(
    faces: NDArray[np.uint32], normals: NDArray[np.float64], angle_deg: float
) -> list[int]:
    """Flood fill over shared edges, one face at a time."""
    edges: dict[frozenset[int], list[int]] = {}
    for row, face in enumerate(faces.tolist()):
        for a, b in zip(face, [*face[1:], face[0]], strict=True):
            edges.setdefault(frozenset((a, b)), []).append(row)
    label = [-1] * len(faces)
    for start in range(len(faces)):
        stack = [start] if label[start] < 0 else []
        while stack:
            row = stack.pop()
            label[row] = start
            for a in range(3):
                edge = frozenset((int(faces[row, a]), int(faces[row, (a + 1) % 3])))
                for other in edges[edge]:
                    cosine = float(normals[row] @ normals[other])
                    joined = len(edges[edge]) == 2 and cosine >= np.cos(np.radians(angle_deg))
                    if joined and label[other] < 0:
                        stack.append(other)
    return label


def test_an_edge_of_three_faces_is_sharp() -> None:
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], np.uint32)
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    assert len(set(shading_groups(faces, normals, 30.0).tolist())) == 3


def test_normals_turn_with_the_mesh() -> None:
    rotation = rotation_xyz([20, 50, -70])
    for positions, faces in _shapes():
        turned = (positions @ rotation.T).astype(np.float32)
        straight = _by_corner(smooth_shaded(positions, faces, 33.0)) @ rotation.T
        # Positions move by 6e-8 when rounded; the smallest edge is 0.05 long, and a normal turns
        # by their ratio, a few 1e-6.
        assert np.abs(_by_corner(smooth_shaded(turned, faces, 33.0)) - straight).max() < 1e-5


def test_normals_do_not_depend_on_how_a_flat_side_is_cut() -> None:
    """A prism's side as two triangles or as eight: the same normals at its corners."""
    positions, faces = _arrays(trimesh.creation.cylinder(0.5, 1, sections=16))
    coarse = smooth_shaded(positions, faces, 30.0)
    fine_positions, fine_faces = trimesh.remesh.subdivide(positions, faces)
    fine = smooth_shaded(fine_positions.astype(np.float32), fine_faces.astype(np.uint32), 30.0)
    for position, normal in zip(coarse.positions, coarse.normals, strict=True):
        same = np.abs(fine.positions - position).max(axis=1) < ROUNDING
        assert np.abs(fine.normals[same] - normal).max(axis=1).min() < 1e-5  # as above


def test_no_corner_is_turned_away_from_its_face() -> None:
    for positions, faces in _shapes():
        for angle_deg in (30.0, 180.0):
            corners = _by_corner(smooth_shaded(positions, faces, angle_deg))
            facing = np.einsum("tci,ti->tc", corners, face_normals(positions, faces))
            assert facing.min() > 0.1 - ROUNDING


def test_a_doubled_sheet_has_usable_normals() -> None:
    """Two faces back to back share all three edges; even at 180 degrees no normal vanishes."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = smooth_shaded(positions, np.array([[0, 1, 2], [2, 1, 0]], np.uint32), 180.0)
    assert np.array_equal(_by_corner(mesh)[:, :, 2], [[1, 1, 1], [-1, -1, -1]])
