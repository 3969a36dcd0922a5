"""Maps at the edges of what is lawful, in the renderer: a picture, or a refusal that says why."""

import dataclasses
import tracemalloc

import numpy as np
import pytest

from pipeline.renders.kernel_textures import KernelTextures
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import RenderSettings
from storage.errors import Rejected, TrilightError
from storage.records.environment import Environment
from storage.records.first_hits import first_hits
from storage.records.retextured import with_textures
from storage.records.scene import Scene
from storage.records.texture import MAX_SIDE, Texture
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import join, light, material, quad
from tests.sky_maps import constant, one_sun

pytestmark = pytest.mark.usefixtures("llvm")

CHEAP = RenderSettings(
    resolution=16, noise_floor_db=20.0, min_spp=32, max_spp=32, min_mean_radiance=0.0,
    denoiser="off",
)  # fmt: skip
FLOOR = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
LAMP = light(np.array([[-1, -1, 3], [2, -1, 3], [0, 1, 2.5]]), 5.0)


def floor_scene(sky: Environment | None, *, mirror: bool = False) -> Scene:
    row = material(specular=0.9, roughness=0.01) if mirror else material(diffuse=0.5)
    return join([quad(FLOOR, row), LAMP], eye=(0, -2.5, 2), fov_deg=40, sky=sky)


def textured(*textures: Texture) -> Scene:
    """Return the floor under a diffuse texture whose u runs once over it with x."""
    scene = join([quad(FLOOR, material(diffuse=0.5)), LAMP], eye=(0, -0.02, 4), fov_deg=24)
    index = np.full((len(scene.materials), 3), -1, np.int32)
    index[scene.material_index[0], 0] = 0
    xy = scene.vertex_positions[scene.faces.ravel(), :2]
    made = with_textures(scene, ((xy + 1) / 2).astype(np.float32), textures, index)
    made.check()
    return made


def rendered(scene: Scene) -> RenderedView:
    scene.check()
    return SceneRenderer(scene, CHEAP).render_view(scene.c2w[0], float(scene.fov_deg[0]), 1)


def test_a_sun_of_a_million_gives_a_picture_or_says_that_it_is_too_bright() -> None:
    """On a matt floor a few hundred; in a mirror that sees it more than half floats hold."""
    view = rendered(floor_scene(one_sun(1e6)))
    assert np.isfinite(view.radiance_rgb).all() and view.radiance_rgb.max() > 100
    assert np.isfinite(view.noise_floor_db)
    everywhere = constant(1e6)
    with pytest.raises(Rejected, match="radiance_overflow"):
        rendered(floor_scene(everywhere, mirror=True))


def test_a_black_sky_is_no_sky_in_every_bit() -> None:
    without = rendered(floor_scene(None))
    for seen in (False, True):
        black = rendered(floor_scene(constant(0.0, is_seen=seen)))
        np.testing.assert_array_equal(black.radiance_rgb, without.radiance_rgb)


def test_a_sky_of_two_texels() -> None:
    """The smallest lawful one: seen, it is its radiance in each pixel; it lights as a larger one.

    128 pixels of 32 samples with a spread of about 1: the means differ by far less than 5 %.
    """
    tiny, large = (
        rendered(floor_scene(constant([0.2, 0.4, 0.8], height=height, is_seen=True)))
        for height in (1, 32)
    )
    assert not tiny.hits[0].any()
    np.testing.assert_allclose(tiny.radiance_rgb[0], [[0.2, 0.4, 0.8]] * 16, rtol=1e-5)
    means = [view.radiance_rgb[view.hits].mean(axis=0) for view in (tiny, large)]
    np.testing.assert_allclose(means[0], means[1], rtol=0.05)


def test_a_texture_of_one_texel_is_its_colour() -> None:
    """It is looked up in the kernel, since nobody took it out of the scene before."""
    one = textured(Texture(texels=np.array([[[0.6, 0.3, 0.1]]], np.float32)))
    seen = load_tracer(one, max_depth=3, rr_depth=2).features(camera_of(one, 16), spp=4)
    middle = seen.albedo[8, 8]
    assert middle == pytest.approx([0.6, 0.3, 0.1], abs=1e-6)


@pytest.mark.parametrize("upright", [False, True])
def test_the_longest_texture_is_looked_up_as_the_records_do(upright: bool) -> None:
    """A ramp of 16,384 texels, whose neighbours differ by 1/16384: float32 places lose no texel."""
    ramp = np.linspace(0, 1, MAX_SIDE, dtype=np.float32)
    texels = np.repeat(ramp[:, None, None] if upright else ramp[None, :, None], 3, axis=-1)
    scene = textured(Texture(texels=np.ascontiguousarray(texels)))
    tracer = load_tracer(scene, max_depth=3, rr_depth=2)
    found = tracer.features(camera_of(scene, 16), spp=4).albedo.mean(axis=(0, 1))
    pixels = first_hits(scene, resolution=32).material[..., :3]
    np.testing.assert_allclose(found, pixels.mean(axis=(0, 1)), atol=2e-3)


def test_memory_for_texels_is_what_is_stated() -> None:
    """16 bytes a colour and no more: they are decoded in blocks, not as a whole in doubles."""
    texels = np.random.default_rng(0).integers(0, 200, (64, MAX_SIDE, 3), np.uint8)
    scene = textured(Texture(texels=texels, is_srgb=True))
    tracemalloc.start()
    try:
        KernelTextures(scene, np.arange(scene.num_triangles))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1.2 * 16 * 64 * MAX_SIDE


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_maps_that_break_a_law_never_reach_a_kernel(value: float) -> None:
    """Whatever opens or renders a scene checks it first; a child of the renderer trusts that."""
    from trilight import render

    texels = np.full((2, 4, 3), 0.5, np.float32)
    texels[1, 2, 0] = value
    below = dataclasses.replace(floor_scene(None), environment=Environment(radiance_rgb=texels))
    look = np.full((2, 2, 3), 0.25, np.float32)
    look[0, 1, 1] = value
    plain = textured(Texture(texels=np.full((2, 2, 3), 0.25, np.float32)))
    wrong = dataclasses.replace(plain, textures=(Texture(texels=look),))
    for scene, name in ((below, "environment.radiance_rgb"), (wrong, "textures")):
        with pytest.raises(TrilightError, match=name):
            render(scene, resolution=16, max_spp=8)
