"""Laws of light from all around: the furnace, the six directions, motion, black and seen maps."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from pipeline.renders.load_tracer import load_tracer
from scene_templates.rotations import uniform_rotation
from storage.conventions import camera_rays
from storage.records.lookup import environment_values
from storage.records.passes.pictures import view_passes
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.sampling import assert_agree, camera_of, render_blocks
from tests.pipeline.renders.scene_kit import box, join, material, sphere
from tests.pipeline.renders.test_sky_paths import open_scene
from tests.rigid_motion import moved
from tests.sky_maps import COLOURS, POLES, constant, one_sun, six_poles, smooth

pytestmark = pytest.mark.usefixtures("llvm")

TRACERS = [load_tracer, pytest.param(PluginTracer, marks=pytest.mark.slow("statistics"))]


@pytest.mark.parametrize(
    ("tracer", "shape"),
    [(load_tracer, sphere), (load_tracer, box),
     pytest.param(PluginTracer, sphere, marks=pytest.mark.slow("statistics"))],
)  # fmt: skip
def test_white_and_convex_things_vanish_in_a_white_sky(shape: Any, tracer: Any) -> None:
    """The furnace: radiance 1 from everywhere, and a Lambert surface of albedo 1 sends out 1."""
    thing = shape([0, 0, 0], 0.5, material(diffuse=1.0))
    scene = join([thing], eye=(0.4, -2, 0.7), fov_deg=30, sky=constant(1.0))
    loaded = tracer(scene, max_depth=6, rr_depth=5)
    camera = camera_of(scene, 16)
    covered = loaded.features(camera, spp=64).albedo
    inside = covered.min(axis=-1) > 0.999
    pictures = np.array([loaded.radiance(camera, seed=k, spp=64) for k in range(4)])
    found = pictures.mean(axis=0)[inside]
    error = pictures.std(axis=0, ddof=1)[inside] / 2
    assert inside.sum() > 20
    # Where shading normals lean over the facets of a ball, light is lost: measured 0.3 %.
    assert abs(found.mean() - 1) < 0.005
    assert (abs(found - 1) < 5 * error + 0.01).all()
    seen = dataclasses.replace(scene, environment=constant(1.0, is_seen=True))
    picture = tracer(seen, max_depth=6, rr_depth=5).radiance(camera, seed=9, spp=64)
    assert abs(picture.mean() - 1) < 0.005
    # Samples are jittered: some meet a rim that the even rays have missed.
    assert np.abs(picture[covered.max(axis=-1) == 0] - 1).max() < 0.05


@pytest.mark.parametrize("tracer", TRACERS)
def test_a_mirror_shows_each_pole_in_its_place(tracer: Any) -> None:
    """A ball, seen along each axis from outside, shows in its middle what is behind the viewer."""
    rotation = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
    sky = six_poles(rotation=rotation)
    ball = sphere([0, 0, 0], 0.5, material(specular=1.0, roughness=0.01), rings=48)
    for name, pole in POLES.items():
        eye = 3 * (rotation @ np.array(pole, np.float64)) + np.array([1e-3, 2e-3, 3e-3])
        scene = join([ball], eye=eye, fov_deg=0.5, sky=sky)
        picture = tracer(scene, max_depth=3, rr_depth=5).radiance(
            camera_of(scene, 8), seed=1, spp=16
        )
        # The albedo tables of energy compensation are right to 0.1 %, and 1024 samples find all.
        assert picture.mean(axis=(0, 1)) == pytest.approx(COLOURS[name], rel=0.01), name


def test_a_scene_and_its_sky_may_be_turned_together() -> None:
    rotation = uniform_rotation(np.random.default_rng(4))
    sky = one_sun(3e3)
    scene = open_scene(sky)
    turned = dataclasses.replace(sky, rotation=(rotation @ sky.rotation).astype(np.float32))
    there = dataclasses.replace(moved(scene, rotation, [0.3, -0.2, 0.1]), environment=turned)
    here = render_blocks(scene, first_seed=99, passes=8)
    assert_agree(render_blocks(there, passes=8), here)


def test_a_black_sky_is_none() -> None:
    """To the last bit: the kernel is the one without a sky."""
    pictures = []
    for sky in (None, constant(0.0), constant(0.0, is_seen=True)):
        scene = open_scene(sky)
        tracer = load_tracer(scene, max_depth=10, rr_depth=5)
        pictures.append(tracer.radiance(camera_of(scene, 16), seed=1, spp=16))
    np.testing.assert_array_equal(pictures[1], pictures[0])
    np.testing.assert_array_equal(pictures[2], pictures[0])


@pytest.mark.parametrize("tracer", TRACERS)
def test_a_seen_sky_stands_behind_everything(tracer: Any) -> None:
    hidden, seen = (open_scene(smooth(64, is_seen=flag)) for flag in (False, True))
    camera = camera_of(hidden, 64)
    loaded = [tracer(scene, max_depth=3, rr_depth=5) for scene in (hidden, seen)]
    # where surfaces cover nothing of a pixel, nor of its neighbours
    covered = loaded[0].features(camera, spp=64).albedo.any(axis=-1)
    wide = np.pad(covered, 1)
    around = np.array([wide[i : i + 64, j : j + 64] for i in range(3) for j in range(3)])
    empty, inside = ~around.any(axis=0), around.all(axis=0)
    without, with_sky = (one.radiance(camera, seed=1, spp=64) for one in loaded)
    assert empty.sum() > 500 and (without[empty] == 0).all()
    _, rays = camera_rays(hidden.c2w[0], float(hidden.fov_deg[0]), 64)
    assert hidden.environment is not None
    expected = environment_values(hidden.environment, rays)
    # A pixel is 0.8 degrees wide, over which this sky changes by 1 % at most.
    assert np.abs(with_sky[empty] / expected[empty] - 1).max() < 0.01
    # The same samples of the same light; a few of these pixels have a silhouette through them.
    assert abs(with_sky[inside].mean() / without[inside].mean() - 1) < 0.02
    # The pass `coverage` is the alpha of the hidden picture, whoever sees the sky: the map below it
    # is the seen one. Silhouettes are met by 64 jittered rays here and by 64 even ones there.
    alpha, same = (
        view_passes(scene, ["coverage"], view=0, resolution=64, rays_a_side=8)["coverage"]
        for scene in (hidden, seen)
    )
    np.testing.assert_array_equal(alpha, same)
    below = without + (1 - alpha.reshape(64, 64, 1)) * expected
    assert np.abs(below - with_sky).mean() < 0.01 * with_sky.mean()
