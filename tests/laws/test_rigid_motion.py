"""Moving a composed scene with its cameras changes its pictures by noise alone."""

import numpy as np

from pipeline.scenes.sight import Sight
from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.rotations import uniform_rotation
from scene_templates.settings import SceneSettings
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import assert_agree, render_blocks
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.rigid_motion import moved

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


def test_what_a_camera_sees_commutes_with_motion() -> None:
    scene = _scene(0)
    there = moved(scene, uniform_rotation(np.random.default_rng(5)), [1.0, 2.0, -3.0])
    before, after = (Sight(s).facts(s.c2w[0], float(s.fov_deg[0]), 64) for s in (scene, there))
    # 4096 rays: a few graze an edge and fall on the other side after rounding.
    for name in ("coverage", "shell_back", "lit"):
        assert abs(getattr(before, name) - getattr(after, name)) < 0.005, name
