"""Objects do not meet, unless the plan lets them; judged by a slow twin that shares nothing."""

import dataclasses

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.posing import posed
from pipeline.scenes.shapes import MeshShape
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.layout import Pose
from scene_templates.layout_rand import scene_plan
from scene_templates.rotations import uniform_rotation
from scene_templates.settings import SceneSettings
from storage.records.scene import Scene
from storage.settings.changes import changed
from tests.pipeline.scenes.scene_facts import rows_of, triangles_of
from tests.pipeline.scenes.slow_crossings import cross, encloses
from tests.pipeline.scenes.small_pool import first_scene, level

SETTINGS = SceneSettings(families=DEFAULT_FAMILIES)


def _meeting(scene: Scene) -> int:
    """How many pairs of objects meet, by the slow twin."""
    soups = [triangles_of(scene, row) for row in rows_of(scene, "object")]
    return sum(
        cross(one, other) or encloses(one, other)
        for row, one in enumerate(soups)
        for other in soups[:row]
    )


def test_meshes_do_not_meet_where_the_plan_says_so(scenes: list[Scene]) -> None:
    """Scenes are rounded to float32, a ten-millionth of a unit: none of these is so near."""
    pairs = 0
    for index, scene in enumerate(scenes[:60]):
        if not scene_plan(SETTINGS, seed=3, scene_index=index).overlaps:
            assert _meeting(scene) == 0, index
            pairs += len(rows_of(scene, "object")) // 2
    assert pairs > 25


def test_meshes_may_meet_where_the_plan_lets_them(pool: list[PooledAsset]) -> None:
    changes = {"families.num_objects": [3, 3], "placement.overlap_share": 1.0, "num_views": 1}
    settings = changed(SETTINGS, changes)
    scenes = [first_scene(settings, pool, seed=0, scene_index=index) for index in range(12)]
    assert sum(_meeting(scene) > 0 for scene in scenes) > 3


def test_spheres_may_overlap_while_meshes_do_not(scenes: list[Scene]) -> None:
    """Else large objects would crowd each other out, and thin ones keep far too much room."""
    overlapping = 0
    for index, scene in enumerate(scenes):
        if scene_plan(SETTINGS, seed=3, scene_index=index).overlaps:
            continue
        spheres = []
        for row in rows_of(scene, "object"):
            points = triangles_of(scene, row).reshape(-1, 3)
            centre = (points.min(axis=0) + points.max(axis=0)) / 2
            spheres.append((centre, np.linalg.norm(points - centre, axis=1).max()))
        overlapping += any(
            np.linalg.norm(a - b) < r + s
            for k, (a, r) in enumerate(spheres)
            for b, s in spheres[:k]
        )
    assert overlapping > 8


def _pose(rng: np.random.Generator, radius: float) -> Pose:
    return Pose(
        centre=rng.uniform(-0.35, 0.35, size=3), radius=radius, rotation=uniform_rotation(rng)
    )


def _soup(shape: MeshShape, pose: Pose) -> NDArray[np.float64]:
    return posed(shape.points, pose).astype(np.float64)[shape.faces]


def test_meets_agrees_with_the_slow_twin_and_is_symmetric(pool: list[PooledAsset]) -> None:
    rng = np.random.default_rng(0)
    coarse = [MeshShape(entry.locked.uid, entry.asset.levels[-1], "box") for entry in pool]
    found = []
    for _ in range(60):
        one, other = (coarse[row] for row in rng.integers(len(coarse), size=2))
        pose, its_pose = _pose(rng, rng.uniform(0.1, 0.5)), _pose(rng, rng.uniform(0.1, 0.5))
        soup, its_soup = _soup(one, pose), _soup(other, its_pose)
        twin = cross(soup, its_soup) or encloses(soup, its_soup)
        assert one.meets(pose, other, its_pose) == twin
        assert other.meets(its_pose, one, pose) == twin
        found.append(twin)
    assert 12 < sum(found) < 48


def test_a_mesh_inside_another_meets_it() -> None:
    """No triangle touches another here, and a ball in a closed box is not beside it."""
    box = MeshShape("made", level(trimesh.creation.box()), "box")
    ball = MeshShape("made", level(trimesh.creation.icosphere(1)), "box")
    here = Pose(centre=np.zeros(3), radius=0.5, rotation=np.eye(3))
    within = dataclasses.replace(here, radius=0.1)
    assert not cross(_soup(box, here), _soup(ball, within))
    assert box.meets(here, ball, within)
    assert ball.meets(within, box, here)


@pytest.mark.parametrize("gap", [1e-6, 1e-3])
def test_neighbours_that_do_not_touch_do_not_meet(gap: float) -> None:
    """Two cubes side by side in float64: FCL tells a gap of a micrometre."""
    box = MeshShape("made", level(trimesh.creation.box()), "box")
    side = 0.5 / np.sqrt(0.75)
    here = Pose(centre=np.zeros(3), radius=0.5, rotation=np.eye(3))
    beside = dataclasses.replace(here, centre=np.array([side + gap, 0, 0]))
    into = dataclasses.replace(here, centre=np.array([side - gap, 0.01, 0.02]))
    assert not box.meets(here, box, beside)
    assert box.meets(here, box, into)


def test_a_shape_may_be_asked_at_any_size() -> None:
    """Its tree is kept for one size; another size must not be answered by the old tree."""
    ball = MeshShape("made", level(trimesh.creation.icosphere(2)), "box")
    for radius in (0.5, 0.1, 0.5, 0.3, 0.5):
        pose = Pose(centre=np.zeros(3), radius=radius, rotation=np.eye(3))
        far = Pose(centre=np.array([radius + 0.21, 0, 0]), radius=0.2, rotation=np.eye(3))
        near = dataclasses.replace(far, centre=np.array([radius + 0.17, 0, 0]))
        assert not ball.meets(pose, ball, far)
        assert ball.meets(pose, ball, near)
