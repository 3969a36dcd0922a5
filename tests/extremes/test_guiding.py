"""Path guiding at the extremes: finite pictures of the same light, from a bounded table."""

import numpy as np
import pytest

from pipeline.renders.guide_table import BINS
from pipeline.renders.renderer import SceneRenderer
from pipeline.renders.settings import RenderSettings
from pipeline.renders.vector_tracer import VectorTracer
from storage.records.scene import Scene
from tests.pipeline.renders.guided_scenes import FLOOR, LAMP, WALL, lit_by_a_mirror
from tests.pipeline.renders.sampling import assert_agree, camera_of, render_blocks
from tests.pipeline.renders.scene_kit import Part, box, join, light, material, quad, sphere

pytestmark = pytest.mark.usefixtures("llvm")

METAL = material(specular=0.9, roughness=0.3)
MATT = material(diffuse=0.6)
ROOM = [quad(FLOOR, MATT), quad(WALL, METAL), sphere([0, 0.2, 0.4], 0.3, METAL, 6)]


def _seen(parts: list[Part]) -> Scene:
    return join(parts, eye=(0.3, -2.4, 1.0), target=(0, 0.6, 0.4), fov_deg=50)


def _hundred_lamps() -> Scene:
    rng = np.random.default_rng(1)
    lamps = [
        light(np.array(LAMP) * 0.2 + [*rng.uniform(-1.2, 1.2, 2), 1.2], rng.exponential(30.0))
        for _ in range(100)
    ]
    return _seen([*ROOM, *lamps])


def _closed_box() -> Scene:
    walls = box([0, 0, 1], 5.2, material(diffuse=0.5, specular=0.3, roughness=0.3), kind="shell")
    return _seen([walls, *ROOM, light(LAMP, 30.0, 0.5)])


def _lamp_that_fills_the_view() -> Scene:
    """Between the camera and all surfaces, larger than the view; emitters are not seen."""
    sheet = [[-4, -2.0, -3], [4, -2.0, -3], [0, -2.0, 6]]
    return _seen([*ROOM, light(sheet, 1.0)])


SCENES = {
    "lamp behind a mirror": lit_by_a_mirror(0.1),
    "hundred lamps": _hundred_lamps(),
    "roughness 0.01": lit_by_a_mirror(0.3, 0.01),
    "closed box": _closed_box(),
    "lamp that fills the view": _lamp_that_fills_the_view(),
}


@pytest.mark.slow("statistics")
@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_a_guided_picture_has_the_light_of_an_unguided_one(scene: Scene) -> None:
    tracer = VectorTracer(scene, max_depth=10, rr_depth=2)
    guided = tracer.guided()
    guide = guided._scene.guide
    assert guide is not None
    assert len(guide._densities) <= (1 + 4 * 2048) * BINS
    plain = render_blocks(scene, tracer=tracer, block=8, passes=40)
    assert_agree(render_blocks(scene, tracer=guided, block=8, passes=40, first_seed=700), plain)


@pytest.mark.parametrize("name", ["hundred lamps", "roughness 0.01", "lamp that fills the view"])
def test_a_guided_view_is_finite(name: str) -> None:
    scene = SCENES[name]
    settings = RenderSettings(
        resolution=16, noise_floor_db=90.0, min_spp=8, max_spp=512, min_mean_radiance=0.0
    )
    camera = camera_of(scene, 16)
    view = SceneRenderer(scene, settings).render_view(camera.c2w, camera.fov_deg, seed=1)
    assert np.isfinite(view.radiance_rgb).all()
    assert view.radiance_rgb.max() > 0


NOTHING_ARRIVES = {
    "lamp in a black box": [
        *ROOM,
        box([0, 0, 1], 0.5, material()),
        light(np.array(LAMP) * 0.1 + [0, 0, 0.9], 30.0),
    ],
    "only matt surfaces": [quad(FLOOR, MATT), light(LAMP, 30.0)],
    "only mirrors": [quad(FLOOR, material(specular=1.0, roughness=0.01)), light(LAMP, 30.0)],
    "lamp in the plane of all there is": [
        quad(FLOOR, METAL),
        light(np.array(LAMP) * [1, 1, 0] + [5, 0, 0], 30.0),
    ],
}


@pytest.mark.parametrize("parts", NOTHING_ARRIVES.values(), ids=NOTHING_ARRIVES.keys())
def test_where_no_photon_arrives_nothing_is_guided(parts: list[Part]) -> None:
    scene = _seen(parts)
    tracer = VectorTracer(scene, max_depth=10, rr_depth=2)
    guided, camera = tracer.guided(), camera_of(scene, 16)
    assert guided._scene.guide is None
    plain = tracer.radiance(camera, seed=1, spp=16)
    np.testing.assert_array_equal(guided.radiance(camera, seed=1, spp=16), plain)
