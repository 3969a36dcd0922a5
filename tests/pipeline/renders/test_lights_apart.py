"""Each emitter alone: the sum is the picture, light is linear, and lights keep their order."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.renders.denoiser import denoise
from pipeline.renders.kept_light import with_mean_of
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.samples import HalfSamples
from pipeline.renders.settings import RenderSettings
from pipeline.renders.vector_tracer import VectorTracer
from storage.errors import Rejected
from storage.metrics import psnr_log_db
from storage.records.exr import decode_exr, encode_exr
from storage.records.lights import light_rows, rounded_to_half, sum_of_lights
from storage.records.scene import Scene, SceneObject
from tests.oracle.plugin_tracer import PluginTracer
from tests.pipeline.renders.sampling import (
    assert_agree,
    blocks_of,
    camera_of,
    render_passes,
    render_view,
)
from tests.pipeline.renders.scene_kit import join, light, material, quad, sphere

SETTINGS = RenderSettings(
    resolution=32, noise_floor_db=60.0, min_spp=32, max_spp=32, aux_spp=16, per_light=True
)
RAW = dataclasses.replace(SETTINGS, denoiser="off")
LAMPS = np.array([[-0.5, -1.5, 2], [0.5, -1.5, 2], [0, -1, 2.4]])
COLOURS = ([20.0, 2.0, 2.0], [1.0, 10.0, 1.0], [0.5, 0.5, 5.0])


def _beside(*, x: float) -> NDArray[np.float64]:
    return np.add(LAMPS, [x, 0, 0])


def lit_scene(factors: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Scene:
    """Return a ball on a floor below a red, a green and a blue light, beside each other."""
    parts = [
        light(_beside(x=-1.2), np.multiply(COLOURS[0], factors[0])),
        quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], material(diffuse=[0.7, 0.5, 0.3])),
        light(LAMPS, np.multiply(COLOURS[1], factors[1])),
        sphere([0, 0, 0.5], 0.5, material(diffuse=0.4, specular=0.4, roughness=0.5), rings=8),
        light(_beside(x=1.2), np.multiply(COLOURS[2], factors[2])),
    ]
    return join(parts, eye=(0, -3, 2), target=(0, 0, 0.4), fov_deg=45)


def _lights(view: RenderedView) -> NDArray[np.float32]:
    assert view.lights_rgb is not None
    return view.lights_rgb


def test_the_stored_picture_is_the_sum_of_its_lights_in_the_order_of_objects() -> None:
    view = render_view(lit_scene(), SETTINGS)
    lights = _lights(view)
    assert lights.shape == (3, 32, 32, 3)
    np.testing.assert_array_equal(lights, rounded_to_half(lights))
    np.testing.assert_array_equal(sum_of_lights(lights), view.radiance_rgb)
    np.testing.assert_array_equal(decode_exr(encode_exr(view.radiance_rgb)), view.radiance_rgb)
    for light_rgb, colour in zip(lights, COLOURS, strict=True):  # objects 0, 2 and 4
        assert np.argmax(light_rgb.mean(axis=(0, 1))) == np.argmax(colour)


def test_doubling_one_light_doubles_its_picture_and_no_other() -> None:
    """Samples do not depend on a light's strength; twice a float is exact, in halves too."""
    once = _lights(render_view(lit_scene(), RAW))
    twice = _lights(render_view(lit_scene((1, 2, 1)), RAW))
    np.testing.assert_array_equal(twice[[0, 2]], once[[0, 2]])
    # below 6e-5 half floats are steps of 6e-8, of which twice the value has twice as many
    np.testing.assert_allclose(twice[1], 2 * once[1], rtol=0, atol=6e-8)
    assert twice[1].max() > 0


def test_lights_apart_add_up_to_one_denoised_picture() -> None:
    """Not to a sum of denoised ones, each with its bias, in which the floor would not be honest."""
    scene = lit_scene()
    tracer = load_tracer(scene, max_depth=SETTINGS.max_depth, rr_depth=SETTINGS.rr_depth)
    parts = [tracer.only_light(row) for row in light_rows(scene)]
    samples = HalfSamples(parts, camera_of(scene, 32), 0, first_spp=32, max_spp=32)
    assert len(list(samples.passes_to(SETTINGS.max_spp))) == 2
    features = tracer.features(camera_of(scene, 32), spp=SETTINGS.aux_spp)
    raw = samples.mean().sum(axis=0)
    expected = with_mean_of(denoise(raw, features, "high"), raw)
    # rounded to half floats four times, each light and their sum: 2^-11 of each
    np.testing.assert_allclose(
        render_view(scene, SETTINGS).radiance_rgb, expected, rtol=2 * 2**-11, atol=1e-6
    )


def test_denoised_lights_are_linear_within_their_noise() -> None:
    """The denoiser is not linear: what it changes in the other lights is below the floor."""
    once, twice = render_view(lit_scene(), SETTINGS), render_view(lit_scene((1, 2, 1)), SETTINGS)
    for index, factor in enumerate((1, 2, 1)):
        agreement = psnr_log_db(factor * _lights(once)[index], _lights(twice)[index])
        assert agreement > once.noise_floor_db


def test_the_sum_is_the_picture_of_all_lights_at_once(llvm: None) -> None:
    """The same integral, by other samples: raw means of 8 x 8 blocks agree within their errors."""
    scene = lit_scene()
    tracer = load_tracer(scene, max_depth=6, rr_depth=5)
    lights = [tracer.only_light(row) for row in light_rows(scene)]
    apart = blocks_of(np.sum([render_passes(one, scene, passes=12) for one in lights], axis=0), 8)
    together = blocks_of(render_passes(tracer, scene, passes=12), 8)
    assert_agree(apart, together)
    # and the errors are small enough to tell: the lights' own share is far larger
    assert np.median(np.hypot(apart.error, together.error)) < 0.02 * together.mean.mean()


@pytest.mark.slow("statistics")
def test_both_tracers_switch_the_same_light_on(llvm: None) -> None:
    scene = lit_scene()
    for row in (0, 4):
        tracers = [kind(scene, max_depth=2, rr_depth=5) for kind in (VectorTracer, PluginTracer)]
        means = [
            render_passes(one.only_light(row), scene, resolution=16, passes=4).mean(axis=(0, 1, 2))
            for one in tracers
        ]
        # 65,536 paths of direct light with a relative deviation near 1: half a percent is exceeded
        # once in five by chance, 2 % never; the wrong light would be off by a factor of 5 or more
        np.testing.assert_allclose(means[0], means[1], rtol=0.02)


def test_a_light_that_is_off_still_casts_a_shadow_and_is_still_hidden() -> None:
    """A large emitter between floor and lamp: off, it darkens the floor, and no camera sees it."""
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    lamp = light([[-0.5, -0.5, 3], [0.5, -0.5, 3], [0, 0.5, 3]], 50.0)
    screen = light([[-9, -9, 1], [9, -9, 1], [0, 18, 1]], 1.0)
    scene = join([floor, lamp, screen], eye=(0, -0.1, 2))
    lamp_rgb, screen_rgb = _lights(render_view(scene, RAW))
    assert lamp_rgb.max() == 0
    assert screen_rgb.min() > 0  # the floor fills the picture, seen through the screen


def test_lights_apart_have_an_honest_floor_and_reach_a_target() -> None:
    settings = dataclasses.replace(SETTINGS, noise_floor_db=38.0, max_spp=2048)
    view = render_view(lit_scene(), settings)
    assert view.noise_floor_db >= 38.0 and not view.at_cap
    converged = dataclasses.replace(SETTINGS, min_spp=2048, max_spp=2048, per_light=False)
    truth = render_view(lit_scene(), converged, seed=1)
    assert view.noise_floor_db < psnr_log_db(view.radiance_rgb, truth.radiance_rgb)


def test_one_light_alone_is_the_picture_but_for_its_rounding() -> None:
    """With one emitter, both ways draw the same samples."""
    parts = [
        quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], material(diffuse=0.5)),
        light(LAMPS, 20.0),
    ]
    scene = join(parts, eye=(0, -3, 2))
    together = render_view(scene, dataclasses.replace(SETTINGS, per_light=False))
    assert together.lights_rgb is None
    apart = render_view(scene, SETTINGS)
    np.testing.assert_array_equal(apart.radiance_rgb, rounded_to_half(together.radiance_rgb))
    assert apart.noise_floor_db == together.noise_floor_db


def test_an_emitter_without_triangles_is_rejected() -> None:
    scene = lit_scene()
    empty = SceneObject(name="nothing", kind="emitter")
    more = dataclasses.replace(scene, objects=(*scene.objects, empty))
    with pytest.raises(Rejected, match="unlit_scene"):
        SceneRenderer(more, SETTINGS)
