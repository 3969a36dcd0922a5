"""Laws of bringing a mesh to its place."""

import numpy as np
import trimesh

from pipeline.scenes.posing import posed, without_slivers
from scene_templates.layout import Floor, ObjectPlacement, Surface
from scene_templates.rotations import uniform_rotation
from tests.scenes.small_pool import small_pool

TOUCH = 1e-6
"""Coordinates below 2 in float32: 1.2e-7 of rounding each, three to a height."""

SURFACE = Surface(
    diffuse_scale=0.5,
    diffuse_rgb=(0.5, 0.5, 0.5),
    specular=0.4,
    roughness=0.5,
    smooth=False,
    coloured=False,
)


def _placement(rng: np.random.Generator, *, rests: bool) -> ObjectPlacement:
    return ObjectPlacement(
        centre=rng.uniform(-0.5, 0.5, size=3),
        radius=rng.uniform(0.2, 0.5),
        rotation=uniform_rotation(rng),
        rests=rests,
        surface=SURFACE,
    )


def _floor(rng: np.random.Generator) -> Floor:
    normal = np.array([*rng.uniform(-0.1, 0.1, size=2), 1.0])
    return Floor(point=np.array([0, 0, -0.5]), normal=normal / np.linalg.norm(normal))


def test_a_floating_mesh_fills_its_sphere() -> None:
    rng = np.random.default_rng(0)
    for entry in small_pool():
        placement = _placement(rng, rests=False)
        points = posed(entry.asset.levels[0].positions, placement, _floor(rng)).astype(np.float64)
        assert np.abs(points.mean(axis=0) - placement.centre).max() < TOUCH
        reach = np.linalg.norm(points - placement.centre, axis=1).max()
        assert abs(reach - placement.radius) < TOUCH


def test_posing_is_a_similarity() -> None:
    rng = np.random.default_rng(1)
    for entry in small_pool():
        source = entry.asset.levels[-1].positions.astype(np.float64)
        for rests in (False, True):
            points = posed(
                entry.asset.levels[-1].positions, _placement(rng, rests=rests), _floor(rng)
            )
            before = np.linalg.norm(source[:, None] - source[None], axis=-1)
            after = np.linalg.norm(points[:, None] - points[None], axis=-1)
            ratio = after.max() / before.max()
            assert np.abs(after - ratio * before).max() < 5 * TOUCH  # differences of differences


def test_a_resting_mesh_touches_the_floor_straight_below_its_sphere() -> None:
    rng = np.random.default_rng(2)
    for entry in small_pool():
        placement, floor = _placement(rng, rests=True), _floor(rng)
        points = posed(entry.asset.levels[0].positions, placement, floor).astype(np.float64)
        assert abs(floor.height(points).min()) < TOUCH
        moved = points.mean(axis=0) - placement.centre
        assert np.linalg.norm(np.cross(moved, floor.normal)) < TOUCH


def test_slivers_go_and_all_else_stays() -> None:
    mesh = trimesh.creation.icosphere(1)
    positions = mesh.vertices.astype(np.float32)
    faces = mesh.faces.astype(np.uint32)
    middle = (positions[0] + positions[1]) / 2
    padded = np.concatenate([positions, [middle.astype(np.float32)]])
    sliver = np.array([[0, 1, 1], [0, 0, 0]], np.uint32)
    kept = without_slivers(padded, np.concatenate([faces[:3], sliver, faces[3:]]))
    assert np.array_equal(kept, faces)
