"""Radiance knows no length: the picture of a scene is that of its twin of another size."""

import dataclasses

import numpy as np
import pytest

from pipeline.renders.load_tracer import choose_tracing_scale
from pipeline.renders.settings import RenderSettings
from storage.metrics import psnr_log_db
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.renders.sampling import render_view
from tests.pipeline.renders.scene_kit import join, light, material, quad, sampled_like_scene

SETTINGS = RenderSettings(
    resolution=32, noise_floor_db=99.0, min_spp=64, max_spp=64, min_mean_radiance=0.0
)


def resized(scene: Scene, factor: float) -> Scene:
    """Return a scene so many times as large, with its lamps and cameras."""
    c2w = scene.c2w.copy()
    c2w[:, :3, 3] *= np.float32(factor)
    positions = scene.vertex_positions * np.float32(factor)
    return dataclasses.replace(scene, vertex_positions=positions, c2w=c2w)


def scene_of_a_metre(index: int) -> Scene:
    scene = sampled_like_scene(np.random.default_rng(index), num_views=1)
    seen = scene.vertex_positions[scene.faces[~scene.triangle_emits]].reshape(-1, 3)
    return resized(scene, 1 / float(np.linalg.norm(np.ptp(seen, axis=0))))


@pytest.mark.usefixtures("llvm")
@for_each("size", [1e-4, 2.0**-13, 0.05, 30.0, 2.0**13, 1e4])
def test_a_twin_of_another_size_has_the_same_picture_and_stated_error(size: float) -> None:
    """From a watch of 0.1 mm to a city of 10 km; to the bit where sizes are powers of two."""
    scene = scene_of_a_metre(4)
    known, twin = (render_view(each, SETTINGS) for each in (scene, resized(scene, size)))
    if size == 2.0 ** round(np.log2(size)):
        np.testing.assert_array_equal(twin.radiance_rgb, known.radiance_rgb)
    apart_db = psnr_log_db(twin.radiance_rgb, known.radiance_rgb)
    assert apart_db > twin.noise_floor_db - 3  # two pictures of this error, at most independent
    assert abs(twin.noise_floor_db - known.noise_floor_db) < 1
    np.testing.assert_array_equal(twin.hits, known.hits)


def test_size_is_that_of_what_is_seen() -> None:
    """Not of lamps and cameras, however far away; what is about a metre stays as it is."""
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    lamp = light([[-0.1, -0.1, 900], [0, 0.1, 900], [0.1, -0.1, 900]], 100.0)
    assert choose_tracing_scale(join([floor, lamp])) == 1
    assert choose_tracing_scale(resized(join([floor, lamp]), 3.5)) == 1
    assert choose_tracing_scale(resized(join([floor, lamp]), 1e-3)) == 2.0**8
    assert choose_tracing_scale(resized(join([floor, lamp]), 1e3)) == 2.0**-11
