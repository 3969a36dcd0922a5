"""Seeing and rendering commute with rigid motion, with a mirror and an exchange of channels."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from pipeline.scenes.views import Visibility
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.rotations import uniform_rotation
from scene_templates.settings import SceneSettings
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import assert_agree, render_blocks
from tests.pipeline.renders.scene_kit import bumpy_room, open_scene
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.rigid_motion import moved
from tests.sky_maps import one_sun

SETTINGS = SceneSettings(families=DEFAULT_FAMILIES, num_views=1)


def _scene(scene_index: int) -> Scene:
    return first_scene(SETTINGS, small_pool(), seed=11, scene_index=scene_index)


@pytest.mark.parametrize(
    "made",
    [lambda: _scene(0), lambda: open_scene(one_sun(3e3)), bumpy_room],
    ids=["composed", "sky", "normal map"],
)
def test_rendering_commutes_with_motion(made: Callable[[], Scene]) -> None:
    scene = made()
    there = moved(scene, uniform_rotation(np.random.default_rng(0)), [0.3, -0.2, 0.1])
    # Frames around normals turn differently, so that the same seed means other samples.
    here = render_blocks(scene, first_seed=99, passes=8)
    assert_agree(render_blocks(there, passes=8), here, slack=1e-3)


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
