"""What networks are judged beside: methods without one, the path tracer, raw references."""

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from infra.bench.workloads.judged_pictures import difference_db
from infra.render.comparison import Frame, flicker
from infra.render.networks import (
    DirectLightRenderer,
    NetworkRenderer,
    traced_network,
    untrained_network,
)
from infra.render.raw_references import RawReference, true_error_db
from infra.timed_views import Show, timed_views
from infra.tracer_rival import LADDER, Level, Price, TracerRival, chosen_level
from model.config import hits_smoke
from model.neural_renderer import NeuralRenderer
from pipeline.exchange.open_scene import SceneSource
from pipeline.renders.noise_floor import clamped_radiance
from storage.conventions import log10_radiance
from storage.errors import TrilightError
from storage.metrics import psnr_linear_db, psnr_log_db
from storage.records.sample import Sample
from storage.renderer import Camera, Renderer
from tests.for_each import case
from tests.train.kit import tiny_run
from tests.train.toy import toy_sample, toy_scene
from train.loop.state import new_state

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


def test_the_first_view_pays_for_loading_and_the_round_that_warms_up_counts_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [0.0]
    loaded = [100.0, 3.0, 5.0, 4.0]
    monkeypatch.setattr(time, "process_time", lambda: now[0])

    def load() -> Show:
        now[0] += loaded.pop(0)

        def show() -> np.ndarray:
            now[0] += 1.0
            return np.full((2, 2, 3), now[0], np.float32)

        return show

    found = timed_views(load, repeats=3)
    assert not loaded
    assert (found.first_s, found.further_s) == (5.0, 1.0)  # the median of 3, 5 and 4, and a view
    assert found.radiance_rgb[0, 0, 0] == now[0], "the last picture"


def prices(*, sample_s: float, fast_s: float, high_s: float, most: int) -> Mapping[Level, Price]:
    found: dict[Level, Price] = {}
    for spp in LADDER[:most]:
        found[spp, "fast"] = Price(first_s=1.0, further_s=spp * sample_s + fast_s)
        found[spp, "high"] = Price(first_s=1.0, further_s=spp * sample_s + high_s)
    return found


@given(st.floats(0, 100))
def test_the_most_samples_that_fit_and_then_the_better_filter(most_s: float) -> None:
    one = prices(sample_s=1.0, fast_s=0.5, high_s=3.0, most=6)
    spp, denoiser = chosen_level([one], most_s)
    chosen_s = one[spp, denoiser].further_s
    if most_s < 1.5:  # not even one sample with the fast filter fits
        assert (spp, denoiser) == (1, "fast")
        return
    assert chosen_s <= most_s
    for (other_spp, other), price in one.items():
        if price.further_s <= most_s:
            assert (other_spp, other == "high") <= (spp, denoiser == "high")


def test_scenes_vote_by_their_median_and_what_was_not_tried_takes_longer() -> None:
    cheap = prices(sample_s=1.0, fast_s=0.0, high_s=0.5, most=5)
    dear = prices(sample_s=10.0, fast_s=0.0, high_s=0.5, most=3)
    assert chosen_level([cheap, cheap, dear], 8.2) == (8, "fast"), "one is outvoted"
    assert chosen_level([cheap, dear, dear], 12.0) == (1, "high")
    assert chosen_level([cheap, dear], 16.0) == (2, "high"), "of two, both have to be asked"
    assert chosen_level([dear], 1.0) == (1, "fast")


class Counted(TracerRival):
    """Shows black, and starts no child."""

    def shown(self, sample: Sample, view: int) -> np.ndarray:
        return np.zeros((16, 16, 3), np.float32)


JUDGED = [(64, 10, 10 * 2), (10, 10, 10), (4, 10, 4), (1, 10, 1)]


def test_it_is_judged_on_no_more_views_than_asked_from_all_over_the_split() -> None:
    for most, scenes, judged in JUDGED:
        with case(most):
            rival = Counted(16, most_views=most, num_scenes=scenes)
            asked = [
                (
                    number,
                    rival.judged(dataclasses.replace(toy_sample(0), key=f"{number:09d}"), view),
                )
                for number in range(scenes)
                for view in range(2)
            ]
            numbers = [number for number, picture in asked if picture is not None]
            assert len(numbers) == judged <= most
            assert max(numbers) >= scenes // 2 or most == 1
            views = "all views" if most == 64 else "the first view"
            assert rival.which.startswith(f"{views} of ")
            assert ("each scene" in rival.which) == (most >= scenes)


def test_without_a_path_tracer_it_says_so_and_the_network_is_timed_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TRILIGHT_VARIANT", "none_such")
    network, samples = new_state(tiny_run()).model, [toy_sample(0), toy_sample(1)]
    lacking = TracerRival(16, most_views=4, num_scenes=2).measure(network, samples)
    assert lacking.preview is None and "TRILIGHT_VARIANT is 'none_such'" in lacking.missing
    unasked = TracerRival(16, most_views=0, num_scenes=2).measure(network, samples)
    assert unasked.preview is None and unasked.missing == "no views of it were requested"
    for times in (lacking, unasked):
        assert times.scenes == 2 and 0 < times.network_further_s < times.network_first_s
    with pytest.raises(TrilightError, match="resolution is 20"):
        TracerRival(20, most_views=4, num_scenes=2).measure(network, samples)


@pytest.mark.slow("references")
def test_it_is_timed_beside_the_network_and_traces_the_stored_scene() -> None:
    rival = TracerRival(16, most_views=4, num_scenes=2)
    network = new_state(tiny_run()).model
    dark = toy_sample(1)
    unlit = np.zeros_like(dark.scene.materials)
    unlit[:, :3] = 0.5
    dark = dataclasses.replace(dark, scene=dataclasses.replace(dark.scene, materials=unlit))
    try:
        times = rival.measure(network, [toy_sample(0), dark])
        assert times.preview is not None and times.scenes == 2
        assert 0 < times.preview.further_s < times.preview.first_s
        sample = toy_sample(0)
        once, again = rival.judged(sample, 0), rival.shown(sample, 0)
        other = rival.shown(sample, 1)
        assert once is not None and again is not None and other is not None
        assert once.shape == (16, 16, 3) and once.max() > 0
        np.testing.assert_array_equal(once, again)
        assert not np.array_equal(once, other)
        assert rival.shown(dark, 0) is None
        alone = rival.measure(network, [dark])
        assert alone.missing == "the scenes that were timed cannot be traced"
        rival.close()
        after = rival.shown(sample, 0)
        assert after is not None
        np.testing.assert_array_equal(once, after)
    finally:
        rival.close()
