"""Far from the defaults: scenes still keep every law, or are rejected with a reason."""

from typing import Any

import pytest

from pipeline.scenes.pool import PooledAsset
from scene_templates.settings import SceneSettings
from tests.scenes.small_pool import first_scene

EXTREMES: list[dict[str, Any]] = [
    {"fov_deg": (100.0, 110.0)},
    {"fov_deg": (10.0, 12.0)},
    {"camera_distance": (1.0, 1.0)},
    {"camera_distance": (4.0, 4.0), "min_coverage": 0.001},
    {"num_lights": (32, 32)},
    {"light_scale": (0.01, 0.01)},
    {"light_scale": (10.0, 10.0), "total_emission": (1e-3, 1e-3)},
    {"total_emission": (1e9, 1e9)},
    {"num_objects": (8, 8), "object_scale": (0.4, 0.6), "max_triangles": 16384},
    {"shell_tilt_deg": 10.0, "square_share": 0.0},
    {"smooth_share": 1.0, "coloured_share": 1.0, "smooth_angle_deg": 180.0},
    {"smooth_share": 1.0, "smooth_angle_deg": 0.0},
    {"roughness_log": (0.06, 0.06)},
    {"num_views": 16, "coverage_grid": 5},
]


@pytest.mark.parametrize("changes", EXTREMES, ids=lambda changes: "+".join(changes))
def test_extreme_settings_keep_the_laws(pool: list[PooledAsset], changes: dict[str, Any]) -> None:
    settings = SceneSettings(**changes)
    for seed in (0, 2**63):
        for index in range(4):
            scene = first_scene(settings, pool, seed=seed, scene_index=index)
            scene.check()
            assert scene.num_views == settings.num_views
            assert scene.num_triangles <= settings.max_triangles
