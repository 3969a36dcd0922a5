"""The path tracer in the network's own time: which samples fit, which views it is judged on."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from infra.tracer_rival import LADDER, Level, Price, TracerRival, chosen_level
from storage.errors import TrilightError
from storage.records.sample import Sample
from tests.for_each import case
from tests.train.kit import tiny_run
from tests.train.toy import toy_sample
from train.loop.state import new_state


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
    assert unasked.preview is None and unasked.missing == "nobody asked for its views"
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
