"""Rigid motion commutes with the laws of the scene record, with storing it, and with itself."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_templates.rotations import uniform_rotation
from storage.errors import TrilightError
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import ARRAY_FIELDS, Scene
from tests.rigid_motion import moved
from tests.scenes_by_hand import tiny_sample, tiny_scene

ROUNDING = 1e-6
"""Coordinates below 4 in float32 are exact to 2.4e-7; two motions round twice."""


def _motion(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    return uniform_rotation(rng), rng.normal(0, 0.5, size=3)


@pytest.mark.parametrize("seed", range(2))
def test_a_moved_scene_keeps_every_law(seed: int) -> None:
    there = moved(tiny_scene(), *_motion(seed))
    there.check()
    for name in set(ARRAY_FIELDS) - {"vertex_positions", "vertex_normals", "c2w"}:
        assert np.array_equal(getattr(there, name), getattr(tiny_scene(), name))


@pytest.mark.parametrize("seed", range(2))
def test_a_broken_scene_stays_broken(seed: int) -> None:
    scene = tiny_scene()
    for changes in (
        {"vertex_normals": 1.5 * scene.vertex_normals},
        {"faces": scene.faces + np.uint32(5)},
        {"fov_deg": -scene.fov_deg},
    ):
        broken = dataclasses.replace(scene, **changes)
        for candidate in (broken, moved(broken, *_motion(seed))):
            with pytest.raises(TrilightError):
                candidate.check()


@pytest.mark.parametrize("seed", range(2))
def test_moving_and_storing_may_change_places(seed: int) -> None:
    sample, motion = tiny_sample(), _motion(seed)

    def stored(scene: Scene) -> Scene:
        members = encode_sample(dataclasses.replace(sample, scene=scene))
        return decode_sample(sample.key, members).scene

    first, second = stored(moved(sample.scene, *motion)), stored(sample.scene)
    second = moved(second, *motion)
    for name in ARRAY_FIELDS:
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


@pytest.mark.parametrize("seed", range(2))
def test_distances_and_what_cameras_see_stay(seed: int) -> None:
    scene, (rotation, shift) = tiny_scene(), _motion(seed)
    there = moved(scene, rotation, shift)
    back = moved(there, rotation.T, -rotation.T @ shift)
    for before, after in ((scene, there), (there, back)):
        for view in range(scene.num_views):
            seen = [_in_camera(s, view) for s in (before, after)]
            # Far and near points: eight times the rounding of one coordinate.
            assert np.abs(seen[0] - seen[1]).max() < 8 * ROUNDING
    assert np.abs(back.vertex_positions - scene.vertex_positions).max() < 4 * ROUNDING


def _in_camera(scene: Scene, view: int) -> NDArray[np.float64]:
    pose = scene.c2w[view].astype(np.float64)
    return (scene.vertex_positions.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
