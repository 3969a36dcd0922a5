"""What networks are judged beside: methods without one, the path tracer, raw references."""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from infra.bench.workloads.judged_pictures import difference_db
from infra.render.networks import (
    DirectLightRenderer,
    NetworkRenderer,
    traced_network,
    untrained_network,
)
from infra.render.path_tracer import MOST_SCENES, PathTracer, RenderChild, RenderWorker
from infra.render.quality import FixedSamples, ToStatedError
from infra.render.raw_references import RawReference, true_error, true_error_db
from infra.render.run_render import Frame, flicker
from model.config import hits_smoke
from model.inference import NeuralRenderer
from pipeline.exchange.open_scene import SceneSource
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.noise_floor import clamped_radiance
from pipeline.renders.settings import NoiseTargets
from storage.conventions import log10_radiance
from storage.errors import Unrenderable
from storage.metrics import psnr_linear_db, psnr_log_db
from storage.renderer import Camera, Image, Renderer, Sampling, fingerprint
from tests.for_each import case
from tests.scenes_by_hand import tiny_scene
from tests.train.toy import toy_scene

SCENE = toy_scene(2)
PX = 16


def shown(renderer: Renderer) -> np.ndarray:
    return renderer.load(SCENE, "toy").render(Camera.of_scene(SCENE, 0)).radiance_rgb


def network(opened: NeuralRenderer) -> NetworkRenderer:
    return NetworkRenderer(checkpoint="toy", resolution=PX, opened=opened)


def test_light_of_lamps_is_what_is_left_when_nothing_is_gathered() -> None:
    of_lamps = shown(DirectLightRenderer(resolution=PX))
    config = dataclasses.replace(hits_smoke(), gather_rays=0)
    # the network's picture went through log10(1 + radiance) in float32
    np.testing.assert_allclose(
        of_lamps, shown(network(untrained_network(config))), rtol=1e-4, atol=1e-5
    )
    assert of_lamps.max() > 0.01
    everything = shown(network(traced_network()))
    assert everything.mean() > of_lamps.mean(), "other surfaces send light too"


def test_the_smallest_layers_show_what_large_ones_show() -> None:
    small = shown(network(traced_network()))
    unfiltered = dataclasses.replace(hits_smoke(), filter_width=0)
    large = shown(network(untrained_network(unfiltered)))
    np.testing.assert_allclose(small, large, rtol=1e-3, atol=1e-4)  # sums in another order


def frame(name: str, key: str | None, error: float) -> Frame:
    return Frame(
        source=SceneSource(path=Path(name), key=key),
        error_RR3=np.full((4, 4, 3), error, np.float32),
        noise_floor_db=20.0,
    )


FRAMES: list[tuple[tuple[str, str | None], tuple[str, str | None], bool]] = [
    (("a.safetensors", None), ("a.safetensors", None), True),
    (("stage.usda", "1"), ("stage.usda", "2"), True),
    (("s.tar", "000000001"), ("s.tar", "000000001"), True),
    (("s.tar", "000000001"), ("s.tar", "000000002"), False),
    (("0.h5", None), ("1.h5", None), False),
]


def test_only_frames_of_one_scene_or_stage_flicker() -> None:
    for before, now, goes_on in FRAMES:
        with case((before, now, goes_on)):
            found = flicker(frame(*before, 0.1), frame(*now, 0.2))
            assert (found is not None) == goes_on
            if found is not None:
                # a change of 0.1 everywhere is 20 dB; two floors of 20 dB are 3 dB worse together
                assert found.db == pytest.approx(20, abs=1e-4)
                assert found.noise_db == pytest.approx(20 - 10 * np.log10(2))


def test_the_first_frame_flickers_not_and_equal_errors_are_capped() -> None:
    first = frame("a.safetensors", None, 0.1)
    assert flicker(None, first) is None
    calm = flicker(first, first)
    assert calm is not None and calm.db == 100


HALF_PX = 64
EVERYWHERE = np.ones((HALF_PX, HALF_PX), bool)


def _truth() -> NDArray[np.float64]:
    return np.linspace(0.05, 0.9, HALF_PX * HALF_PX * 3).reshape(HALF_PX, HALF_PX, 3)


def _noisy(rng: np.random.Generator, spread: float) -> NDArray[np.float64]:
    return _truth() + rng.normal(0, spread, (HALF_PX, HALF_PX, 3))


def test_noise_of_the_reference_does_not_count() -> None:
    """Halves with three times the picture's error: 12,288 values leave 0.4 dB open, here thrice."""
    rng = np.random.default_rng(0)
    picture = (_truth() + rng.normal(0, 0.01, (HALF_PX, HALF_PX, 3))).astype(np.float32)
    halves = RawReference(a_rgb=_noisy(rng, 0.03), b_rgb=_noisy(rng, 0.03))
    for curve, metric in ((log10_radiance, psnr_log_db), (clamped_radiance, psnr_linear_db)):
        exact = metric(picture, _truth().astype(np.float32))
        found, open_db = true_error_db(picture, halves, curve, EVERYWHERE)
        assert found == pytest.approx(exact, abs=1.3)
        assert 0.2 < open_db < 0.8, "and it says how much that is"
        plain = metric(picture, (0.5 * (halves.a_rgb + halves.b_rgb)).astype(np.float32))
        assert plain < exact - 5, "the mean of the halves would have hidden the picture's error"


@pytest.mark.parametrize("noise", [0.002, 0.03])
def test_what_a_reference_leaves_open_is_how_far_its_errors_spread(noise: float) -> None:
    """Of a known picture, where the error is far above the noise and where it is far below.

    The channels of a pixel have one noise, as those of a path do.
    """
    rng = np.random.default_rng(3)
    picture = (_truth() + rng.normal(0, 0.01, (HALF_PX, HALF_PX, 3))).astype(np.float32)
    found, opens = [], []
    for _ in range(200):
        a, b = (_truth() + rng.normal(0, noise, (HALF_PX, HALF_PX, 1)) for _ in range(2))
        error, spread = true_error(
            picture, RawReference(a_rgb=a, b_rgb=b), clamped_radiance, EVERYWHERE
        )
        found.append(error)
        opens.append(spread)
    assert np.mean(found) == pytest.approx(1e-4, rel=0.1)
    assert np.sqrt(np.mean(np.square(opens))) == pytest.approx(np.std(found), rel=0.15)


def test_two_renderers_without_noise() -> None:
    rng = np.random.default_rng(1)
    one, other = (
        RawReference(a_rgb=factor * _noisy(rng, 0.05), b_rgb=factor * _noisy(rng, 0.05))
        for factor in (1.0, 1.1)
    )
    apart = log10_radiance(_truth()) - log10_radiance(1.1 * _truth())
    exact = -10 * np.log10(np.square(apart).mean())
    assert difference_db(one, other, log10_radiance) == pytest.approx(exact, abs=0.5)
    same = RawReference(a_rgb=_noisy(rng, 0.05), b_rgb=_noisy(rng, 0.05))
    assert difference_db(one, same, log10_radiance) > exact + 8


TINY = tiny_scene()
TINY_CAMERA = Camera.of_scene(TINY, 0)
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
        grown = growing.load(TINY, "tiny")
        with pytest.raises(Enough):
            grown.render(TINY_CAMERA, stop)
        last = grown.render(TINY_CAMERA, told.append)
        looks = [step for step in told if isinstance(step, Image)]
        assert len(looks) > 3 and any(isinstance(step, Sampling) for step in told)
        assert looks[0].stated_error_db is None and "not measured" in looks[0].remark
        assert last.stated_error_db is not None and (last.samples or 0) > 256
        assert (last.cpu_seconds or 0) > (looks[0].cpu_seconds or 0) > 0
        plain = PathTracer(child, MEASURED, 32).load(TINY, "tiny").render(TINY_CAMERA)
        np.testing.assert_array_equal(last.radiance_rgb, plain.radiance_rgb)
        preview = PathTracer(child, FEW, 32).load(TINY, "tiny")
        assert child._child.call_method(count_loaded) == MOST_SCENES
        picture = preview.render(TINY_CAMERA)
        assert (picture.samples, picture.facts) == (4, {"spp": 4})
        again = grown.render(TINY_CAMERA)  # it was forgotten, and is sent again
        assert psnr_log_db(again.radiance_rgb, last.radiance_rgb) > 90
        dark = tiny_scene(
            faces=TINY.faces[2:],
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
