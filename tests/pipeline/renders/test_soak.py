"""A thousand scenes through render children, as a run makes them: nothing grows."""

import contextlib
import os

import numpy as np
import pytest

from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.renders.renderer import SceneRenderer, set_threads
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import Variant, activate
from tests.pipeline.renders.scene_kit import sampled_like_scene

SETTINGS = RenderSettings(
    resolution=32, noise_floor_db=99.0, min_spp=8, max_spp=8, aux_spp=4, min_mean_radiance=0.0
)
LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=600, calls_per_child=250)
"""A child is replaced three times on the way."""

NUM_SCENES = 1000


def set_up(variant: Variant) -> None:
    activate(variant)
    set_threads(2)


def render_one(index: int) -> tuple[float, int]:
    """Return the mean of a scene's picture and this process' resident bytes."""
    scene = sampled_like_scene(np.random.default_rng(index), num_views=1)
    view = SceneRenderer(scene, SETTINGS).render_view(scene.c2w[0], float(scene.fov_deg[0]), 0)
    return float(view.radiance_rgb.mean()), _resident_bytes()


def _resident_bytes() -> int:
    with open("/proc/self/statm") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow("memory")
def test_a_thousand_scenes_leave_nothing_behind(variant: Variant) -> None:
    parents, children, means = [], [], []
    child = IsolatedChild(limits=LIMITS, setup=set_up, setup_args=(variant,))
    with contextlib.closing(child):
        for index in range(NUM_SCENES):
            mean, resident = child.call(render_one, index)
            means.append(mean)
            children.append(resident)
            parents.append(_resident_bytes())
    assert np.isfinite(means).all() and min(means) >= 0
    # The parent passes numbers on: a leak of one picture (12 kB) each would be 11 MB of some 200.
    assert parents[-1] < 1.03 * parents[100]
    # A child grows by 2 % while its first hundred scenes bring arrays of other sizes; a leak of one
    # scene's arrays (some 100 kB) each would be 15 MB, a tenth.
    for first in range(0, NUM_SCENES, LIMITS.calls_per_child):
        assert children[first + LIMITS.calls_per_child - 1] < 1.05 * children[first + 100]
