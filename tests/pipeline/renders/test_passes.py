"""Rays and passes: of storage.conventions, beside our records and Mitsuba's `aov` integrator.

Mitsuba means other things in two places. Its depth begins at the near plane of its camera, not at
its centre. Its albedo is that of the diffuse lobe wherever the specular one is narrow, since an
integrator cannot ask a material for its albedo and takes one value of the BSDF instead: it is right
only on the scene of `plugin_feature_scene`, where diffuse + specular are one diffuse albedo.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.kernel_scene import CameraRays
from pipeline.renders.tracer import load_tracer
from storage.raycast import Surfaces
from storage.records.passes import view_passes
from storage.records.scene import Scene
from tests.oracle import plugin_scene, plugin_tracer
from tests.oracle.plugin_tracer import _NEAR_CLIP
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import flat, join, light, material, quad, sampled_like_scene

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
    full = coverage == 1
    # the piece of a ray before the near plane is longer to the side
    before = _NEAR_CLIP * ours["depth_ray_m"][full] / ours["depth_axis_m"][full]
    off = abs(theirs[..., 0][full] + before - ours["depth_ray_m"][full])
    assert (off > 5e-6).mean() <= 0.002
    if a_side == 1:
        hit = theirs[..., 0] > 0
        rows = np.flatnonzero(~scene.triangle_emits)[theirs[..., 10].astype(int)]
        assert (hit != ours["hit"]).sum() <= 1
        assert (np.where(hit, rows, -1) != ours["triangle"]).mean() <= 0.002


def test_rays_of_mitsuba_find_the_triangles_of_embree() -> None:
    """As on a GPU: ids agree but for pixels on rims, and so do depths where ids do."""
    scene = sampled_like_scene(np.random.default_rng(0), num_views=1)
    names = ["triangle", "object", "depth_ray_m", "coverage"]
    expected, found = (
        view_passes(scene, names, resolution=64, rays_a_side=2, surfaces=caster(scene))
        for caster in (Surfaces, CameraRays)
    )
    agree = found["triangle"] == expected["triangle"]
    assert 0.2 < expected["coverage"].mean()
    assert agree.mean() > 0.999  # measured: 1
    for name in names[1:]:
        np.testing.assert_allclose(found[name][agree], expected[name][agree], rtol=1e-5)
    lamps = join([light([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], 1.0)], eye=(0, -0.1, 2))
    nothing = view_passes(lamps, ["hit"], resolution=8, surfaces=CameraRays(lamps))
    assert not nothing["hit"].any()


def test_a_lit_square_covers_the_pixels_that_it_should() -> None:
    """Edges on pixel borders: inside fully lit, outside exactly black, nothing mirrored."""
    resolution, distance = 16, 2.0
    unit = 2 * np.tan(np.radians(20)) * distance / resolution  # one pixel at the square's depth
    left, right, top, bottom = 3, 7, 2, 10  # in pixels from the top left corner
    x0, x1 = (unit * (column - resolution / 2) for column in (left, right))
    z0, z1 = (unit * (resolution / 2 - row) for row in (bottom, top))
    square = quad([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]], material(diffuse=1))
    lamp = light([[-50, -30, -30], [50, -30, -30], [0, -30, 60]], 1.0)
    scene = join([square, lamp], eye=(0, -distance, 0), fov_deg=40)
    tracer = load_tracer(scene, max_depth=2, rr_depth=5)
    camera = camera_of(scene, resolution)
    expected = np.zeros((resolution, resolution), bool)
    expected[top:bottom, left:right] = True
    picture = tracer.radiance(camera, seed=0, spp=64)
    features = tracer.features(camera, spp=64)
    np.testing.assert_array_equal(tracer.hits(camera), expected)
    # A sample within a float32 rounding of a border may fall on its other side.
    np.testing.assert_allclose(features.albedo[..., 0], expected, atol=0.02)
    np.testing.assert_allclose(features.normal, expected[..., None] * [0, -1, 0], atol=0.02)
    assert (picture[expected] > 0.2).all()
    assert (picture[~expected] < 0.02).all()


def test_emitters_are_invisible_to_the_auxiliary_pictures() -> None:
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    in_front = flat([[[-1, -1, 0.5], [1, -1, 0.5], [0, 1, 0.5]]], material(emission=1), "emitter")
    lamp = light([[-1, -1, 3], [1, -1, 3], [0, 1, 3]], 1.0)
    pictures = [
        load_tracer(join(parts, eye=(0, -0.1, 2)), max_depth=2, rr_depth=5)
        for parts in ([floor, lamp], [floor, lamp, in_front])
    ]
    camera = camera_of(join([floor, lamp], eye=(0, -0.1, 2)), 16)
    without, with_emitter = (tracer.features(camera, spp=16) for tracer in pictures)
    np.testing.assert_array_equal(without.albedo, with_emitter.albedo)
    np.testing.assert_array_equal(without.normal, with_emitter.normal)
    np.testing.assert_array_equal(pictures[0].hits(camera), pictures[1].hits(camera))
