"""A picture that grows ends as the one that is made at once; each state says what it cost."""

import numpy as np
import pytest

from pipeline.making import progressive_tracer as module
from pipeline.making.progressive_tracer import ProgressiveTracer
from pipeline.renders.preview import PreviewRenderer, PreviewSettings, usual_filter
from pipeline.renders.progressive import FIRST_LOOKS_SPP, ProgressiveRenderer
from pipeline.renders.renderer import SceneRenderer, finished
from pipeline.renders.results import GrowingPicture, Sampling
from pipeline.renders.settings import RenderSettings
from pipeline.renders.variant import choose_variant
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.scene import Scene
from tests.scenes_by_hand import tiny_scene

GROWING = RenderSettings(
    resolution=32, noise_floor_db=95.0, min_spp=16, max_spp=256, min_mean_radiance=0.0
)


def looks(scene: Scene) -> list[GrowingPicture]:
    found: list[Sampling] = []
    steps = ProgressiveRenderer(scene, GROWING).view_steps(scene.c2w[0], 45.0, 7)
    try:
        while True:
            found.append(next(steps))
    except StopIteration as end:
        found.append(end.value)
    return [step for step in found if isinstance(step, GrowingPicture)]


def test_the_last_look_is_the_picture_and_the_others_come_nearer() -> None:
    scene = tiny_scene()
    view = finished(SceneRenderer(scene, GROWING).view_steps(scene.c2w[0], 45.0, 7))
    seen = looks(scene)
    np.testing.assert_array_equal(seen[-1].radiance_rgb, view.radiance_rgb)
    assert seen[-1].floor is not None and seen[-1].floor.log_db == view.noise_floor_db
    few = len(FIRST_LOOKS_SPP)
    assert [look.spp for look in seen[:few]] == list(FIRST_LOOKS_SPP)
    assert all(look.floor is None for look in seen[:few])
    measured = seen[few:]
    assert len(measured) > 1 and [look.spp for look in measured] == sorted(
        {look.spp for look in measured}
    )
    assert all(look.floor is not None for look in measured)
    errors_db = [psnr_log_db(look.radiance_rgb, view.radiance_rgb) for look in seen[:-1]]
    assert errors_db[few] > errors_db[0] + 3
    spent = [look.core_s for look in measured]
    assert spent == sorted(spent) and all(look.core_s > 0 for look in seen)


def test_a_preview_of_the_same_scene_is_the_one_that_render_makes() -> None:
    scene = tiny_scene()
    renderer = ProgressiveRenderer(scene, GROWING)
    for spp in (4, 64):
        steps = renderer.preview_steps(scene.c2w[0], 45.0, 7, spp)
        first = next(steps)
        look = finished(steps)
        assert not isinstance(first, GrowingPicture) and first.expected_spp == spp
        assert (look.spp, look.floor) == (spp, None) and look.core_s > 0
        asked = PreviewSettings(resolution=32, spp=spp, denoiser=usual_filter(spp))
        alone = finished(PreviewRenderer(scene, asked).view_steps(scene.c2w[0], 45.0, 7))
        np.testing.assert_array_equal(look.radiance_rgb, alone.radiance_rgb)


def test_the_child_keeps_the_scene_and_ends_where_it_is_told_to() -> None:
    class Enough(Exception):
        pass

    scene, told = tiny_scene(), list[Sampling]()
    tracer = ProgressiveTracer(variant=choose_variant(), threads=1)
    camera = (scene.c2w[0], 45.0)

    def stop(step: Sampling) -> None:
        raise Enough

    try:
        with pytest.raises(Enough):
            tracer.paint(scene, "a", camera, GROWING, stop)
        tracer.paint(scene, "a", camera, GROWING, told.append)
        last = told[-1]
        assert isinstance(last, GrowingPicture)
        expected = looks(scene)[-1].radiance_rgb
        assert psnr_log_db(last.radiance_rgb, expected) > 30
        tracer.paint(scene, "a", camera, GROWING, told.append, preview_spp=4)
        assert isinstance(told[-1], GrowingPicture) and told[-1].spp == 4
        assert tracer._child.call(_num_loaded) == 1, "a preview loads no scene anew"
        dark = tiny_scene(faces=tiny_scene().faces[2:], material_index=np.array([1], np.uint16),
                          object_index=np.array([1], np.uint16))  # fmt: skip
        with pytest.raises(TrilightError, match="no_surfaces"):
            tracer.paint(dark, "dark", camera, GROWING, told.append)
        for key in ("b", "c", "d"):
            tracer.paint(scene, key, camera, GROWING, told.append)
        kept = tracer._child.call(_num_loaded)
        assert kept == module.MOST_SCENES
    finally:
        tracer.close()


def _num_loaded() -> int:
    return len(module._state.loaded)
