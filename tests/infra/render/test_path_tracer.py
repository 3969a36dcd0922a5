"""The path tracer in its child: what it keeps, how it is stopped, what it refuses."""

import contextlib

import numpy as np
import pytest

from infra.render.path_tracer import MOST_SCENES, PathTracer, RenderChild, RenderWorker
from infra.render.quality import FixedSamples, ToStatedError
from pipeline.renders.settings import NoiseTargets
from pipeline.renders.variant import choose_variant
from storage.errors import Unrenderable
from storage.metrics import psnr_log_db
from storage.renderer import Camera, Image, Sampling, fingerprint
from tests.scenes_by_hand import tiny_scene

SCENE = tiny_scene()
CAMERA = Camera.of_scene(SCENE, 0)
FEW = FixedSamples(spp=4, denoiser="fast")
MEASURED = ToStatedError(targets=NoiseTargets(log_db=95.0), max_spp=1024)


class Enough(Exception):
    """Ends a picture."""


def test_path_tracers_share_a_child_that_can_be_stopped_and_keeps_few_scenes() -> None:
    told = list[Sampling | Image]()

    def stop(step: Sampling | Image) -> None:
        raise Enough

    with contextlib.closing(RenderChild(choose_variant(), threads=1)) as child:
        growing = PathTracer(child, MEASURED, 32, shows_looks=True)
        grown = growing.load(SCENE, "tiny")
        with pytest.raises(Enough):
            grown.render(CAMERA, stop)
        last = grown.render(CAMERA, told.append)
        looks = [step for step in told if isinstance(step, Image)]
        assert len(looks) > 3 and any(isinstance(step, Sampling) for step in told)
        assert looks[0].stated_error_db is None and "not measured" in looks[0].remark
        assert last.stated_error_db is not None and (last.samples or 0) > 256
        assert (last.cpu_seconds or 0) > (looks[0].cpu_seconds or 0) > 0
        plain = PathTracer(child, MEASURED, 32).load(SCENE, "tiny").render(CAMERA)
        np.testing.assert_array_equal(last.radiance_rgb, plain.radiance_rgb)
        preview = PathTracer(child, FEW, 32).load(SCENE, "tiny")
        assert child._child.call_method(count_loaded) == MOST_SCENES
        picture = preview.render(CAMERA)
        assert (picture.samples, picture.facts) == (4, {"spp": 4})
        again = grown.render(CAMERA)  # it was forgotten, and is sent again
        assert psnr_log_db(again.radiance_rgb, last.radiance_rgb) > 90
        dark = tiny_scene(
            faces=SCENE.faces[2:],
            material_index=np.array([1], np.uint16),
            object_index=np.array([1], np.uint16),
        )
        with pytest.raises(Unrenderable, match="^dark cannot be rendered .no_surfaces"):
            growing.load(dark, "dark")


def count_loaded(worker: RenderWorker) -> int:
    """Return the number of scenes in a child."""
    return len(worker._loaded)


def test_a_fingerprint_tells_quality_width_and_seed_apart() -> None:
    child = RenderChild(choose_variant(), threads=1)
    tracers = [
        PathTracer(child, FEW, 32),
        PathTracer(child, FEW, 32, seed=1),
        PathTracer(child, FEW, 64),
        PathTracer(child, MEASURED, 32),
    ]
    assert len({fingerprint(tracer.identity) for tracer in tracers}) == len(tracers)
    assert fingerprint(PathTracer(child, FEW, 32, name="other").identity) == fingerprint(
        tracers[0].identity
    )
