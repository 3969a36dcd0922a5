"""The path tracer in a network's own time: which samples are chosen, and which views are traced."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from storage.errors import TrilightError, Unrenderable
from storage.records.scene import Scene
from storage.renderer import Camera, Image, OnProgress, Renderer, ignore_progress
from tests.for_each import case
from tests.train.toy import toy_sample
from train.evaluation.equal_time import Filter, Level, spread_text, spread_views, time_both
from train.evaluation.timing import Price, time_scene

FILTERS: tuple[Filter, ...] = ("fast", "high")
LADDER = tuple(1 << step for step in range(13))


JUDGED = [(64, 10, 10 * 2), (10, 10, 10), (4, 10, 4), (1, 10, 1)]


def test_it_is_judged_on_no_more_views_than_asked_from_all_over_the_split() -> None:
    for most, scenes, judged in JUDGED:
        with case(most):
            every, first = spread_views(most, scenes)
            numbers = [number for number in range(0, scenes, every) for view in range(2)[:first]]
            assert len(numbers) == judged <= most
            assert max(numbers) >= scenes // 2 or most == 1
            views = "all views" if most == 64 else "the first view"
            assert spread_text(every, first, 2).startswith(f"{views} of ")
            assert ("each scene" in spread_text(every, first, 2)) == (most >= scenes)


class Clocked:
    """Renderer that says what it takes; loading takes longest in the first round."""

    name = "clocked"
    resolution = 16
    identity: Mapping[str, str] = {}
    notes: Sequence[str] = ()
    seconds = 0.0

    def __init__(self, further_s: float, *, dark: str = "", lacking: str = "") -> None:
        self.further_s = further_s
        self.cpu_seconds: float | None = None
        self.loads = 0
        self._dark = dark
        self._lacking = lacking

    def load(self, scene: Scene, name: str) -> "Clocked":
        if self._lacking:
            raise TrilightError(self._lacking)
        if name == self._dark:
            raise Unrenderable(f"{name}: nothing shines")
        self.cpu_seconds = [100.0, 3.0, 5.0, 4.0][self.loads % 4]
        self.loads += 1
        return self

    def render(self, camera: Camera, on_progress: OnProgress = ignore_progress) -> Image:
        return Image(radiance_rgb=np.zeros((16, 16, 3), np.float32), cpu_seconds=self.further_s)

    def close(self) -> None:
        pass


def test_the_first_view_pays_for_loading_and_the_round_that_warms_up_counts_not() -> None:
    renderer = Clocked(1.0)
    timed = time_scene(renderer, toy_sample(0).scene, "scene", rounds=3)
    # the median of 3, 5 and 4, and a view
    assert (renderer.loads, timed.price) == (4, Price(first_s=5.0, further_s=1.0))


def test_samples_double_until_they_take_longer_than_the_network() -> None:
    previews: dict[Level, Renderer] = {
        (spp, denoiser): Clocked(spp * (1.0 if denoiser == "fast" else 1.4), dark="000000001")
        for spp in LADDER
        for denoiser in FILTERS
    }
    samples = [toy_sample(0), dataclasses.replace(toy_sample(1), key="000000001")]
    times = time_both(Clocked(6.0), previews, samples, note="slow")
    assert times.preview is not None and times.scenes == 2 and times.missing == ""
    assert (times.preview.samples, times.preview.denoiser) == (4, "high")
    assert (times.preview.further_s, times.preview.note) == (5.6, "slow")
    tried = [level for level, each in previews.items() if isinstance(each, Clocked) and each.loads]
    assert tried == [*((spp, denoiser) for spp in (1, 2, 4) for denoiser in FILTERS), (8, "fast")]
    least = time_both(Clocked(0.5), previews, samples)
    assert least.preview is not None, "where nothing fits, the cheapest is shown"
    assert (least.preview.samples, least.preview.denoiser) == (1, "fast")


def test_without_a_path_tracer_it_says_so_and_the_network_is_timed_all_the_same() -> None:
    network, sample = Clocked(6.0), toy_sample(0)
    broken: Mapping[Level, Renderer] = {(1, "fast"): Clocked(1.0, lacking="no tracer here.")}
    dark: Mapping[Level, Renderer] = {(1, "fast"): Clocked(1.0, dark=sample.key)}
    for previews, missing, said in (
        (broken, "", "no tracer here"),
        (dark, "", "the scenes that were timed cannot be traced"),
        ({}, "no views of it were requested", "no views of it were requested"),
    ):
        with case(said):
            times = time_both(network, previews, [sample], missing=missing)
            assert times.preview is None and times.missing == said
            assert times.network_further_s == 6.0 and times.scenes == 1
    with pytest.raises(TrilightError, match="resolution is 20"):
        time_both(Clocked(1.0, lacking="resolution is 20"), {}, [sample])
