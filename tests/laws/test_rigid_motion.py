"""Rigid motion commutes with the laws of the record, with storing, seeing and rendering."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.scenes.visibility import Visibility
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.rotations import uniform_rotation
from scene_templates.settings import SceneSettings
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.sample import decode_sample, encode_sample
from storage.records.scene import ARRAY_FIELDS, Scene
from tests.pipeline.renders.sampling import assert_agree, render_blocks
from tests.pipeline.scenes.small_pool import first_scene, small_pool
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


SETTINGS = SceneSettings(families=DEFAULT_FAMILIES, num_views=1)


def _scene(scene_index: int) -> Scene:
    return first_scene(SETTINGS, small_pool(), seed=11, scene_index=scene_index)


def test_rendering_commutes_with_motion() -> None:
    scene = _scene(0)
    rotation = uniform_rotation(np.random.default_rng(0))
    there = moved(scene, rotation, [0.3, -0.2, 0.1])
    # Frames around normals turn differently, so that the same seed means other samples.
    here = render_blocks(scene, first_seed=99, passes=8)
    assert_agree(render_blocks(there, passes=8), here)


def test_rendering_commutes_with_a_mirror_and_with_an_exchange_of_channels() -> None:
    scene, flip, order = _scene(0), np.diag([-1.0, 1.0, 1.0]), np.array([2, 0, 1])
    pose = scene.c2w.copy()
    pose[:, :3, :3] = flip @ pose[:, :3, :3] @ flip
    pose[:, 0, 3] *= -1
    mirrored = dataclasses.replace(
        scene,
        vertex_positions=(scene.vertex_positions @ flip).astype(np.float32),
        vertex_normals=(scene.vertex_normals @ flip).astype(np.float32),
        faces=scene.faces[:, [0, 2, 1]],
        c2w=pose,
    )
    recoloured = scene.materials.copy()
    for part in (DIFFUSE, SPECULAR, EMISSION):
        recoloured[:, part] = recoloured[:, part][:, order]
    here = render_blocks(scene, first_seed=99, passes=8)
    for other, seen in (
        (mirrored, np.s_[:, ::-1]),
        (dataclasses.replace(scene, materials=recoloured), np.s_[..., np.argsort(order)]),
    ):
        other.check()
        there = render_blocks(other, passes=8)
        back = dataclasses.replace(there, mean=there.mean[seen], error=there.error[seen])
        assert_agree(back, here)
        with pytest.raises(AssertionError, match="of what is allowed"):
            assert_agree(there, here)


def test_what_a_camera_sees_commutes_with_motion() -> None:
    scene = _scene(0)
    there = moved(scene, uniform_rotation(np.random.default_rng(5)), [1.0, 2.0, -3.0])
    before, after = (Visibility(s).facts(s.c2w[0], float(s.fov_deg[0]), 64) for s in (scene, there))
    # 4096 rays: a few graze an edge and fall on the other side after rounding.
    for name in ("coverage", "shell_back", "lit"):
        assert abs(getattr(before, name) - getattr(after, name)) < 0.005, name
