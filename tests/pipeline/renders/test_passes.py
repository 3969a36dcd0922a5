"""Passes beside Mitsuba's own `aov` integrator, on the scenes of stock plugins.

Mitsuba means other things in two places. Its depth begins at the near plane of its camera, not at
its centre. Its albedo is that of the diffuse lobe wherever the specular one is narrow, since an
integrator cannot ask a material for its albedo and takes one value of the BSDF instead: it is right
only on the scene of `plugin_feature_scene`, where diffuse + specular are one diffuse albedo.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.load_tracer import load_tracer
from storage.records.passes.pictures import view_passes
from storage.records.scene import Scene
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import sampled_like_scene

RESOLUTION = 32
CHANNELS = {
    "depth_ray_m": slice(0, 1),
    "position_m": slice(1, 4),
    "geometric_normal": slice(4, 7),
    "shading_normal": slice(7, 10),
    "triangle": slice(10, 11),
    "albedo": slice(11, 14),
}
AOVS = "d:depth,p:position,g:geo_normal,s:sh_normal,t:prim_index,a:albedo"


def _mitsuba(scene: Scene, a_side: int) -> NDArray[np.float64]:
    """Return the channels [R, R, 14], of rays on the same grid; 0 where rays meet nothing."""
    load_tracer(scene, max_depth=2, rr_depth=5)  # chooses a variant
    from tests.oracle import plugin_scene, plugin_tracer

    picture = plugin_tracer._render(
        plugin_scene.plugin_feature_scene(scene),
        plugin_tracer._integrator(type="aov", aovs=AOVS),
        camera_of(scene, RESOLUTION),
        seed=0,
        spp=a_side**2,
        jitter=False,
    )
    return picture.astype(np.float64)


@pytest.mark.parametrize(("seed", "a_side"), [(0, 4), (1, 1)])
def test_mitsuba_sees_the_same(seed: int, a_side: int) -> None:
    scene = sampled_like_scene(np.random.default_rng(seed), num_views=1)
    theirs = _mitsuba(scene, a_side)
    ours = view_passes(scene, resolution=RESOLUTION, rays_a_side=a_side)
    coverage = ours["coverage"]
    assert 0.2 < coverage.mean() <= 1
    ours["albedo"] = ours["material_diffuse"] + ours["material_specular"]
    # measured: 7e-7 for positions, 5e-6 for normals; float32 rays may pass a rim on either side
    for name, atol in (("position_m", 5e-6), ("geometric_normal", 2e-6),
                       ("shading_normal", 2e-5), ("albedo", 2e-6)):  # fmt: skip
        mean = np.nan_to_num(ours[name]) * coverage[..., None]
        off = abs(theirs[..., CHANNELS[name]] - mean).max(axis=-1)
        assert (off > atol).mean() <= 0.002, (name, np.sort(off.ravel())[-5:])
    _compare_depth(scene, ours, theirs)
    if a_side == 1:
        hit = theirs[..., 0] > 0
        rows = np.flatnonzero(~scene.triangle_emits)[theirs[..., 10].astype(int)]
        assert (hit != ours["hit"]).sum() <= 1
        assert (np.where(hit, rows, -1) != ours["triangle"]).mean() <= 0.002


def _compare_depth(scene: Scene, ours: dict[str, NDArray], theirs: NDArray[np.float64]) -> None:
    from tests.oracle.plugin_tracer import _NEAR_CLIP

    full = ours["coverage"] == 1
    # the piece of a ray before the near plane is longer to the side
    before = _NEAR_CLIP * ours["depth_ray_m"][full] / ours["depth_axis_m"][full]
    off = abs(theirs[..., 0][full] + before - ours["depth_ray_m"][full])
    assert (off > 5e-6).mean() <= 0.002
