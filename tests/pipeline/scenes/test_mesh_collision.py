"""Meshes in their places, shaded, where they do not meet; judged by slow twins."""

import dataclasses
import itertools
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.scenes.compose import MeshShape, normalize_to_unit_sphere, pose_points
from pipeline.scenes.shading_normals import (
    ShadedMesh,
    face_normals,
    flat_shaded,
    shading_groups,
    smooth_shaded,
    without_slivers,
)
from pipeline.scenes.triangle_budget import PooledAsset
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.layout import Pose
from scene_templates.rotations import rotation_xyz, uniform_rotation
from scene_templates.sample_layout import scene_plan
from scene_templates.settings import SceneSettings
from storage.records.scene import Scene
from storage.settings.overrides import apply_overrides
from tests.pipeline.scenes.scene_facts import ray_distances, rows_of, triangles_of
from tests.pipeline.scenes.small_pool import first_scene, level, small_pool

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
        flat, smooth = flat_shaded(positions, faces), smooth_shaded(positions, faces, 30.0)
        for mesh in (flat, smooth):
            assert np.array_equal(mesh.positions[mesh.faces], positions[faces])
            assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < ROUNDING
            assert set(mesh.faces.ravel().tolist()) == set(range(len(mesh.positions)))
        geometric = face_normals(positions, faces)
        assert np.abs(_by_corner(flat) - geometric[:, None]).max() < ROUNDING
        assert len(flat.positions) == 3 * len(faces)
        # Coplanar means a cosine of at least 1 in float64: within 2e-8 radians of each other.
        sharp = smooth_shaded(positions, faces, 0.0)
        assert np.abs(_by_corner(sharp) - _by_corner(flat)).max() < ROUNDING
        for angle_deg in (30.0, 180.0):  # no corner is turned away from its face
            corners = _by_corner(smooth_shaded(positions, faces, angle_deg))
            assert np.einsum("tci,ti->tc", corners, geometric).min() > 0.1 - ROUNDING


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


def test_groups_agree_with_those_of_trimesh() -> None:
    for positions, faces in _shapes():
        normals = face_normals(positions, faces)
        beside = trimesh.graph.face_adjacency(faces)
        cosine = np.sum(np.prod(normals[beside], axis=1), axis=1)
        for angle_deg in (10.0, 30.0, 60.0):
            groups = shading_groups(faces, normals, angle_deg).tolist()
            joined = beside[cosine >= np.cos(np.radians(angle_deg))]
            twin = trimesh.graph.connected_component_labels(joined, len(faces)).tolist()
            pairs = set(zip(groups, twin, strict=True))
            assert len(pairs) == len(set(twin)) == len(set(groups))


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


def test_a_doubled_sheet_has_usable_normals() -> None:
    """Two faces back to back share all three edges; even at 180 degrees no normal vanishes."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = smooth_shaded(positions, np.array([[0, 1, 2], [2, 1, 0]], np.uint32), 180.0)
    assert np.array_equal(_by_corner(mesh)[:, :, 2], [[1, 1, 1], [-1, -1, -1]])


def cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether two triangle soups [T, 3, 3] cut each other.

    Triangles that cut each other, and do not lie in one plane, have an edge of one through the
    inside of the other. Mere touching is left open.
    """
    for soup, triangles in ((one, other), (other, one)):
        start, end = soup.reshape(-1, 3), np.roll(soup, -1, axis=1).reshape(-1, 3)
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        near = ((np.maximum(start, end) >= low) & (np.minimum(start, end) <= high)).all(axis=1)
        if (ray_distances(start[near], (end - start)[near], triangles) < 1).any():
            return True
    return False


def encloses(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether the box of one soup lies in the box of the other."""
    low, high = one.min(axis=(0, 1)), one.max(axis=(0, 1))
    other_low, other_high = other.min(axis=(0, 1)), other.max(axis=(0, 1))
    inside = (low >= other_low).all() and (high <= other_high).all()
    outside = (low <= other_low).all() and (high >= other_high).all()
    return bool(inside or outside)


SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)


def _meeting(scene: Scene) -> int:
    """How many pairs of objects meet, by the slow twin."""
    soups = [triangles_of(scene, row) for row in rows_of(scene, "object")]
    return sum(
        cross(one, other) or encloses(one, other)
        for row, one in enumerate(soups)
        for other in soups[:row]
    )


def test_meshes_meet_only_where_the_plan_lets_them(
    scenes: list[Scene], pool: list[PooledAsset]
) -> None:
    """Scenes are rounded to float32, a ten-millionth of a unit: none of these is so near."""
    pairs = 0
    for index, scene in enumerate(scenes[:60]):
        if not scene_plan(SETTINGS, seed=3, scene_index=index).overlaps:
            assert _meeting(scene) == 0, index
            pairs += len(rows_of(scene, "object")) // 2
    assert pairs > 25
    changes = {"families.num_objects": [3, 3], "placement.overlap_share": 1.0, "num_views": 1}
    settings = apply_overrides(SETTINGS, changes)
    may = [first_scene(settings, pool, seed=0, scene_index=index) for index in range(12)]
    assert sum(_meeting(scene) > 0 for scene in may) > 3


def _pose(rng: np.random.Generator, radius: float) -> Pose:
    return Pose(
        centre=rng.uniform(-0.35, 0.35, size=3), radius=radius, rotation=uniform_rotation(rng)
    )


def _soup(shape: MeshShape, pose: Pose) -> NDArray[np.float64]:
    return pose_points(shape.points, pose).astype(np.float64)[shape.faces]


def test_meets_agrees_with_the_slow_twin_and_is_symmetric(pool: list[PooledAsset]) -> None:
    rng = np.random.default_rng(0)
    coarse = [MeshShape(entry.locked.uid, entry.asset.levels[-1], "box") for entry in pool]
    found = []
    for _ in range(60):
        one, other = (coarse[row] for row in rng.integers(len(coarse), size=2))
        pose, its_pose = _pose(rng, rng.uniform(0.1, 0.5)), _pose(rng, rng.uniform(0.1, 0.5))
        soup, its_soup = _soup(one, pose), _soup(other, its_pose)
        twin = cross(soup, its_soup) or encloses(soup, its_soup)
        assert one.overlaps(pose, other, its_pose) == twin
        assert other.overlaps(its_pose, one, pose) == twin
        found.append(twin)
    assert 12 < sum(found) < 48


HERE = Pose(centre=np.zeros(3), radius=0.5, rotation=np.eye(3))


def _at(x: float, y: float = 0.0, z: float = 0.0, radius: float = 0.5) -> Pose:
    return dataclasses.replace(HERE, centre=np.array([x, y, z]), radius=radius)


def test_meshes_inside_and_beside_each_other_and_of_any_size() -> None:
    """No triangle touches another where a ball is in a closed box, and it is not beside it."""
    box = MeshShape("made", level(trimesh.creation.box()), "box")
    ball = MeshShape("made", level(trimesh.creation.icosphere(2)), "box")
    within = _at(0, radius=0.1)
    assert not cross(_soup(box, HERE), _soup(ball, within))
    assert box.overlaps(HERE, ball, within) and ball.overlaps(within, box, HERE)
    side = 0.5 / np.sqrt(0.75)
    for gap in (1e-6, 1e-3):  # two cubes in float64: FCL tells a gap of a micrometre
        assert not box.overlaps(HERE, box, _at(side + gap))
        assert box.overlaps(HERE, box, _at(side - gap, 0.01, 0.02))
    # A shape's tree is kept for one size; another size must not be answered by the old tree.
    for radius in (0.5, 0.1, 0.5, 0.3, 0.5):
        assert not ball.overlaps(_at(0, radius=radius), ball, _at(radius + 0.21, radius=0.2))
        assert ball.overlaps(_at(0, radius=radius), ball, _at(radius + 0.17, radius=0.2))


TOUCH = 1e-6
"""Coordinates below 2 in float32: 1.2e-7 of rounding each, three to a height."""


def _off_centre() -> NDArray[np.float32]:
    """A level that is not in the middle of its source: half of a ball is gone."""
    ball = trimesh.creation.icosphere(2)
    points = level(ball).positions
    return points[points[:, 0] > 0]


def test_the_centre_is_the_mean_of_the_vertices_or_the_middle_of_the_source() -> None:
    for entry in small_pool():
        points = normalize_to_unit_sphere(entry.asset.levels[0].positions, "vertex_mean")
        # Sums of a thousand float64 below 1.
        assert np.abs(points.mean(axis=0)).max() < 1e-12
        assert abs(np.linalg.norm(points, axis=1).max() - 1) < 1e-12
    moved = normalize_to_unit_sphere(_off_centre() + np.float32(0.3), "vertex_mean")
    # Positions are float32 before they are centred: 6e-8 of a number below 1, over a radius of 0.5.
    assert np.abs(moved - normalize_to_unit_sphere(_off_centre(), "vertex_mean")).max() < TOUCH
    # It is the origin of the asset's unit box, however a level is cut: levels fit each other.
    points = normalize_to_unit_sphere(_off_centre(), "box")
    assert np.array_equal(
        points, _off_centre() / np.linalg.norm(_off_centre().astype(float), axis=1).max()
    )
    assert abs(np.linalg.norm(points, axis=1).max() - 1) < 1e-12
    assert points[:, 0].min() >= 0  # the middle is where the other half would begin


def test_posing_is_a_similarity_that_fills_its_sphere() -> None:
    rng = np.random.default_rng(0)
    centrings: tuple[Literal["box", "vertex_mean"], ...] = ("box", "vertex_mean")
    for entry, centring in itertools.product(small_pool(), centrings):
        pose = _pose(rng, rng.uniform(0.2, 0.5))
        source = normalize_to_unit_sphere(entry.asset.levels[-1].positions, centring)
        points = pose_points(source, pose)
        assert points.dtype == np.float32
        reach = np.linalg.norm(points - pose.centre, axis=1).max()
        assert abs(reach - pose.radius) < TOUCH
        before, after = (
            np.linalg.norm(each[:, None] - each[None], axis=-1)
            for each in (source, points.astype(np.float64))
        )
        assert np.abs(after - pose.radius * before).max() < 5 * TOUCH  # differences of differences


def test_slivers_go_and_all_else_stays() -> None:
    mesh = trimesh.creation.icosphere(1)
    positions = mesh.vertices.astype(np.float32)
    faces = mesh.faces.astype(np.uint32)
    middle = (positions[0] + positions[1]) / 2
    padded = np.concatenate([positions, [middle.astype(np.float32)]])
    sliver = np.array([[0, 1, 1], [0, 0, 0]], np.uint32)
    kept = without_slivers(padded, np.concatenate([faces[:3], sliver, faces[3:]]))
    assert np.array_equal(kept, faces)
