"""Laws of bringing a mesh to its place."""

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.scenes.posing import in_unit_sphere, posed, without_slivers
from scene_templates.layout import Pose
from scene_templates.rotations import uniform_rotation
from tests.pipeline.scenes.small_pool import level, small_pool

TOUCH = 1e-6
"""Coordinates below 2 in float32: 1.2e-7 of rounding each, three to a height."""


def _pose(rng: np.random.Generator) -> Pose:
    return Pose(
        centre=rng.uniform(-0.5, 0.5, size=3),
        radius=rng.uniform(0.2, 0.5),
        rotation=uniform_rotation(rng),
    )


def _off_centre() -> NDArray[np.float32]:
    """A level that is not in the middle of its source: half of a ball is gone."""
    ball = trimesh.creation.icosphere(2)
    points = level(ball).positions
    return points[points[:, 0] > 0]


def test_the_mean_of_the_vertices_becomes_the_centre_where_published() -> None:
    for entry in small_pool():
        points = in_unit_sphere(entry.asset.levels[0].positions, "vertex_mean")
        # Sums of a thousand float64 below 1.
        assert np.abs(points.mean(axis=0)).max() < 1e-12
        assert abs(np.linalg.norm(points, axis=1).max() - 1) < 1e-12
    moved = in_unit_sphere(_off_centre() + np.float32(0.3), "vertex_mean")
    # Positions are float32 before they are centred: 6e-8 of a number below 1, over a radius of 0.5.
    assert np.abs(moved - in_unit_sphere(_off_centre(), "vertex_mean")).max() < TOUCH


def test_otherwise_the_middle_of_the_source_does() -> None:
    """It is the origin of the asset's unit box, however a level is cut: levels fit each other."""
    points = in_unit_sphere(_off_centre(), "box")
    assert np.array_equal(
        points, _off_centre() / np.linalg.norm(_off_centre().astype(float), axis=1).max()
    )
    assert abs(np.linalg.norm(points, axis=1).max() - 1) < 1e-12
    assert points[:, 0].min() >= 0  # the middle is where the other half would begin


@pytest.mark.parametrize("centring", ["box", "vertex_mean"])
def test_a_posed_mesh_fills_its_sphere(centring: str) -> None:
    rng = np.random.default_rng(0)
    for entry in small_pool():
        pose = _pose(rng)
        source = in_unit_sphere(entry.asset.levels[0].positions, centring)  # type: ignore[arg-type]
        points = posed(source, pose)
        assert points.dtype == np.float32
        reach = np.linalg.norm(points - pose.centre, axis=1).max()
        assert abs(reach - pose.radius) < TOUCH


def test_posing_is_a_similarity() -> None:
    rng = np.random.default_rng(1)
    for entry in small_pool():
        source = in_unit_sphere(entry.asset.levels[-1].positions, "box")
        pose = _pose(rng)
        points = posed(source, pose).astype(np.float64)
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
