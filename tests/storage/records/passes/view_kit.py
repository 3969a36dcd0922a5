"""Scenes for the tests of passes, and the rays of their pictures."""

import numpy as np
from numpy.typing import NDArray

from storage.conventions import camera_rays, look_at_c2w
from storage.records.scene import Scene
from tests.pipeline.renders.scene_kit import sampled_like_scene
from tests.scenes_by_hand import tiny_scene


def rays_of(
    scene: Scene, resolution: int, view: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return camera_rays(scene.c2w[view], float(scene.fov_deg[view]), resolution)


def room(seed: int = 0, num_views: int = 2) -> Scene:
    """Return shell, objects with curved and flat faces, and lights, in a view with empty pixels."""
    return sampled_like_scene(np.random.default_rng(seed), num_views=num_views)


def from_above(height: float = 1.0, fov_deg: float = 90.0) -> Scene:
    """Return the floor of the tiny scene, seen straight from above, +Y at the picture's top."""
    pose = look_at_c2w(eye=[0, 0, height], target=[0, 0, 0], up=[0, 1, 0])[None]
    return tiny_scene(c2w=pose.astype(np.float32), fov_deg=np.array([fov_deg], np.float32))
