"""Bringing meshes to their places, where they do not meet; judged by a slow twin."""

import dataclasses

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.posing import normalize_to_unit_sphere, pose_points, without_slivers
from pipeline.scenes.shapes import MeshShape
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.layout import Pose
from scene_templates.rotations import uniform_rotation
from scene_templates.sample_layout import scene_plan
from scene_templates.settings import SceneSettings
from storage.records.scene import Scene
from storage.settings.changes import changed
from tests.pipeline.scenes.scene_facts import rows_of, triangles_of
from tests.pipeline.scenes.small_pool import first_scene, level, small_pool

CHUNK = 64


def cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether two triangle soups [T, 3, 3] cut each other.

    Triangles that cut each other, and do not lie in one plane, have an edge of one through the
    inside of the other. Mere touching is left open.
    """
    return _edges_cut(one, other) or _edges_cut(other, one)


def _edges_cut(soup: NDArray[np.float64], triangles: NDArray[np.float64]) -> bool:
    start = soup.reshape(-1, 3)
    along = (np.roll(soup, -1, axis=1) - soup).reshape(-1, 3)
    near = _boxes_near(start, start + along, triangles.reshape(-1, 3))
    start, along = start[near], along[near]
    a, ab, ac = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    for rows in np.array_split(np.arange(len(start)), max(1, len(start) // CHUNK)):
        p = np.cross(along[rows, None], ac[None])
        det = np.sum(p * ab, axis=-1)
        away = start[rows, None] - a
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.sum(p * away, axis=-1) / det
            q = np.cross(away, ab[None])
            v = np.sum(along[rows, None] * q, axis=-1) / det
            t = np.sum(q * ac, axis=-1) / det
            inside = (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)
        if inside.any():
            return True
    return False


def _boxes_near(
    start: NDArray[np.float64], end: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether segments come into the box of some points."""
    low, high = points.min(axis=0), points.max(axis=0)
    below = np.maximum(start, end) < low
    above = np.minimum(start, end) > high
    return np.asarray(~(below | above).any(axis=1))


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
    settings = changed(SETTINGS, changes)
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


def test_a_mesh_inside_another_meets_it() -> None:
    """No triangle touches another here, and a ball in a closed box is not beside it."""
    box = MeshShape("made", level(trimesh.creation.box()), "box")
    ball = MeshShape("made", level(trimesh.creation.icosphere(1)), "box")
    here = Pose(centre=np.zeros(3), radius=0.5, rotation=np.eye(3))
    within = dataclasses.replace(here, radius=0.1)
    assert not cross(_soup(box, here), _soup(ball, within))
    assert box.overlaps(here, ball, within)
    assert ball.overlaps(within, box, here)


@pytest.mark.parametrize("gap", [1e-6, 1e-3])
def test_neighbours_that_do_not_touch_do_not_meet(gap: float) -> None:
    """Two cubes side by side in float64: FCL tells a gap of a micrometre."""
    box = MeshShape("made", level(trimesh.creation.box()), "box")
    side = 0.5 / np.sqrt(0.75)
    here = Pose(centre=np.zeros(3), radius=0.5, rotation=np.eye(3))
    beside = dataclasses.replace(here, centre=np.array([side + gap, 0, 0]))
    into = dataclasses.replace(here, centre=np.array([side - gap, 0.01, 0.02]))
    assert not box.overlaps(here, box, beside)
    assert box.overlaps(here, box, into)


def test_a_shape_may_be_asked_at_any_size() -> None:
    """Its tree is kept for one size; another size must not be answered by the old tree."""
    ball = MeshShape("made", level(trimesh.creation.icosphere(2)), "box")
    for radius in (0.5, 0.1, 0.5, 0.3, 0.5):
        pose = Pose(centre=np.zeros(3), radius=radius, rotation=np.eye(3))
        far = Pose(centre=np.array([radius + 0.21, 0, 0]), radius=0.2, rotation=np.eye(3))
        near = dataclasses.replace(far, centre=np.array([radius + 0.17, 0, 0]))
        assert not ball.overlaps(pose, ball, far)
        assert ball.overlaps(pose, ball, near)


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


@pytest.mark.parametrize("centring", ["box", "vertex_mean"])
def test_a_posed_mesh_fills_its_sphere(centring: str) -> None:
    rng = np.random.default_rng(0)
    for entry in small_pool():
        pose = _pose(rng, rng.uniform(0.2, 0.5))
        source = normalize_to_unit_sphere(entry.asset.levels[0].positions, centring)  # type: ignore[arg-type]
        points = pose_points(source, pose)
        assert points.dtype == np.float32
        reach = np.linalg.norm(points - pose.centre, axis=1).max()
        assert abs(reach - pose.radius) < TOUCH


def test_posing_is_a_similarity() -> None:
    rng = np.random.default_rng(1)
    for entry in small_pool():
        source = normalize_to_unit_sphere(entry.asset.levels[-1].positions, "box")
        pose = _pose(rng, rng.uniform(0.2, 0.5))
        points = pose_points(source, pose).astype(np.float64)
        before = np.linalg.norm(source[:, None] - source[None], axis=-1)
        after = np.linalg.norm(points[:, None] - points[None], axis=-1)
        assert np.abs(after - pose.radius * before).max() < 5 * TOUCH  # differences of differences
        # Not mirrored: the volume of four of its points keeps its sign.
        assert np.linalg.det(pose.rotation) > 0


def test_slivers_go_and_all_else_stays() -> None:
    mesh = trimesh.creation.icosphere(1)
    positions = mesh.vertices.astype(np.float32)
    faces = mesh.faces.astype(np.uint32)
    middle = (positions[0] + positions[1]) / 2
    padded = np.concatenate([positions, [middle.astype(np.float32)]])
    sliver = np.array([[0, 1, 1], [0, 0, 0]], np.uint32)
    kept = without_slivers(padded, np.concatenate([faces[:3], sliver, faces[3:]]))
    assert np.array_equal(kept, faces)
