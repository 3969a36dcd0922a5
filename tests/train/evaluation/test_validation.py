"""Laws of judging: a lead that is sure, a rival that is a median, pictures of errors.

What noise alone would score; and the path tracer in the network's time: which samples are chosen,
which views are traced, over views that have both.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from infra.render.networks import RendererHere, SceneHere
from storage.conventions import log10_radiance, radiance_from_log10
from storage.errors import TrilightError, Unrenderable
from storage.metrics import psnr_log_db
from storage.records.sample import Sample
from storage.records.scene import Scene
from storage.renderer import Camera, Renderer
from storage.renderer import Image as Rendered
from storage.seeds import rng_for
from tests.for_each import case
from tests.train.kit import eval_config
from tests.train.loss.test_training_loss import small_weights
from tests.train.toy import toy_sample, write_toy_dataset
from train.data.scenes import training_scene
from train.evaluation.evaluate import (
    CAPTION,
    TRACER,
    Filter,
    Level,
    Price,
    equal_time,
    judge_views,
    sentences,
    sheet_views,
    spread_text,
    spread_views,
    time_both,
    time_scene,
)
from train.evaluation.metrics import (
    METRICS,
    NETWORK,
    VALIDATED,
    Scores,
    fraction_better,
    lead,
    noise_floors,
    picture_scores,
    summarize_scores,
)
from train.evaluation.report_pages import evaluation_page, record
from train.evaluation.sheet import (
    ERROR_WHITE,
    NOISE_WHITE,
    SheetView,
    draw_sheet,
    error_picture,
    noise_picture,
    write_picture,
)
from train.evaluation.validation import median_picture
from train.loss.training_loss import Lpips


def view_score(log_l1: float, db: float = 0.0) -> Scores:
    return dict.fromkeys(VALIDATED, db) | {"log_l1": log_l1}


def test_a_lead_is_sure_where_scenes_agree_on_it() -> None:
    """Views of one scene are one draw: many of them make no lead surer."""
    rival = [view_score(0.06)] * 12
    agreed = lead([view_score(x) for x in (0.05, 0.052, 0.051) * 4], rival, [3] * 4)
    assert agreed.log_l1 == pytest.approx(0.009) and agreed.is_sure
    one_scene_alone, rival = [view_score(0.02)] * 6 + [view_score(0.0599)] * 18, rival * 2
    doubtful = lead(one_scene_alone, rival, [6] * 4)
    # by hand: 0.04 of one scene and 0.0001 of three; its spread is 0.01995, over two for four
    assert doubtful.log_l1 == pytest.approx(0.010075)
    assert doubtful.error == pytest.approx(0.009975) and not doubtful.is_sure
    assert lead(one_scene_alone, rival, [1] * 24).is_sure, "as so many scenes it would be"
    single = lead([view_score(0.01)] * 2, rival[:2], [2])
    assert single.error is None and not single.is_sure
    assert not lead([view_score(0.07)] * 24, rival, [6] * 4).is_sure


def test_a_summary_shows_the_bad_ones() -> None:
    views = [view_score(float(value), float(value)) for value in range(101)]
    summary = summarize_scores(views)
    assert summary["log_l1"] == 50.0
    assert summary["psnr_log_db_median"] == 50.0
    assert summary["object_psnr_log_db_p5"] == pytest.approx(5.0)
    assert fraction_better(views, views) == 0
    assert fraction_better(views, [view_score(25.5, 25.5)] * 101) == pytest.approx(26 / 101)


def test_no_fixed_picture_has_less_l1_error_than_the_median() -> None:
    scenes = [training_scene(toy_sample(index), 8) for index in range(7)]
    pictures = [scene.target_VRR3.numpy() for scene in scenes]
    targets = np.concatenate(pictures)

    def error(radiance_rgb: np.ndarray) -> float:
        return float(np.abs(log10_radiance(radiance_rgb) - targets).mean())

    median = median_picture(pictures)
    rng = rng_for(0, "rivals")
    middle = 10 ** np.sort(targets, axis=0)[len(targets) // 2] - 1
    rivals = [np.zeros_like(median), middle, 10 ** targets.mean(axis=0) - 1, *(10**targets - 1)]
    rivals += [np.maximum(median + rng.normal(0, 0.01, median.shape), 0) for _ in range(20)]
    # of an even number of views the upper middle is as good: only rounding parts the two
    assert all(error(median) <= error(rival) + 1e-9 for rival in rivals)


def test_error_and_noise_pictures_are_black_where_nothing_shows_and_white_at_their_limit() -> None:
    target = np.full((2, 2, 3), 0.5)
    assert error_picture(target, target).max() == 0
    wrong = (1.5 * 10**ERROR_WHITE) - 1
    assert error_picture(np.full((2, 2, 3), wrong), target).min() == 255

    def view(error: float) -> SheetView:
        return sheet_view(target, np.full_like(target, 1.5 * 10**error - 1))

    assert noise_picture(view(0.0099)).max() == 0
    assert 0 < noise_picture(view(0.02)).mean() < 255
    assert noise_picture(view(0.0101 * NOISE_WHITE)).min() == 255


def sheet_view(target: NDArray, predicted: NDArray) -> SheetView:
    return SheetView(name="", scores="", target_rgb=target, predicted_rgb=predicted, noise=0.01)


def test_the_sheet_shows_every_view(tmp_path: Path) -> None:
    target = np.full((8, 8, 3), 0.2)
    views = [sheet_view(target, target * row) for row in range(3)]
    for name in ("a.png", "b.png"):
        write_picture(tmp_path / name, draw_sheet(views, ("one line", "and another")))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with Image.open(tmp_path / "a.png") as sheet:
        pixels = np.asarray(sheet.convert("RGB"))
    assert pixels.shape[1] > 1000
    assert (pixels == 0).all(axis=-1).any(), "the black prediction of the first view"


def test_floors_of_metrics_without_a_measurement_are_of_drawn_noise() -> None:
    sample = toy_sample(0, resolution=32)
    target, hits = sample.radiance_rgb[0].astype(np.float64), np.ones((32, 32), bool)
    found = {
        floor_db: noise_floors(
            dataclasses.replace(
                sample, views=(dataclasses.replace(sample.views[0], noise_floor_db=floor_db),)
            ),
            0, target, hits, Lpips(*small_weights()),
        )
        for floor_db in (20.0, 40.0)
    }  # fmt: skip
    assert found[20.0]["ssim"] < found[40.0]["ssim"] < 1
    for metric in ("lpips", "hdr_flip", "log_l1", "pepper"):
        assert found[20.0][metric] > found[40.0][metric] > 0
    assert found[40.0]["psnr_log_db"] == 40.0 and found[40.0]["log_l1"] == pytest.approx(0.01)
    # as large as stated, and less where it would make a pixel negative: there at most half is left
    rng = rng_for(0, f"noise of {sample.key}", 0)
    noisy = log10_radiance(target) + rng.normal(0, 0.01, target.shape)
    twin = radiance_from_log10(np.maximum(noisy, 0))
    assert 39.9 < psnr_log_db(twin, target) < 43.1  # 3072 draws are good to 0.1 dB
    assert found[40.0]["ssim"] == picture_scores(twin, target, hits, None)["ssim"]
    without = noise_floors(sample, 0, target, hits, None)
    assert set(METRICS) - set(without) == {"lpips"}


TIMES: dict[str, Any] = {
    "network_first_s": 0.12, "network_further_s": 0.06, "scenes": 4, "missing": "",
    "preview": {
        "samples": 4, "denoiser": "fast", "first_s": 0.025, "further_s": 0.022, "note": "",
    },
}  # fmt: skip


class StoredTargets(RendererHere):
    """Shows the stored pictures themselves."""

    name = TRACER
    resolution = 32

    def __init__(self, samples: Sequence[Sample]) -> None:
        self._pictures = {sample.key: sample.radiance_rgb for sample in samples}

    def load(self, scene: Scene, name: str) -> SceneHere:
        def show(camera: Camera) -> Rendered:
            assert camera.view is not None
            return Rendered(radiance_rgb=self._pictures[name][camera.view], cpu_seconds=None)

        return SceneHere(render_image=show)


def test_both_are_judged_on_the_same_views_and_shown(tmp_path: Path) -> None:
    """What takes longer and what is missing is said; sheets show it beside the prediction."""
    dataset = write_toy_dataset(tmp_path, train=1, validation=3)
    contest = eval_config(dataset, resolution=32, tracer_views=3)
    contest = dataclasses.replace(contest, tracer=StoredTargets(list(contest.samples())))
    views = judge_views(contest, lambda: None)
    assert [TRACER in view.scores for view in views] == [True, False] * 3
    found = equal_time(views, TIMES, "the first view of each scene")
    assert found["views"] == 3
    assert found["tracer"]["psnr_log_db"]["median"] == 100.0, "it shows the target itself"
    leads = [view.scores[NETWORK]["psnr_log_db"] - 100.0 for view in views[::2]]  # type: ignore[operator]
    assert found["lead_db"]["mean"] == pytest.approx(np.mean(leads))
    assert found["lead_db"]["low"] <= found["lead_db"]["mean"] <= found["lead_db"]["high"]
    assert found["share_better"] == 0
    page = evaluation_page(record(views, {}, found))
    assert "In the network's own time".lower() in page.lower()
    assert "takes 0.022 (0.025) with 4 samples a pixel and its fast filter." in page
    assert "takes the network 0.06 CPU seconds, the first of a scene 0.12" in page
    assert list(record(views, {}, found)["contestants"]) == [NETWORK], "a column is of all views"
    dearest = {"samples": 1, "denoiser": "fast", "first_s": 0.1, "further_s": 0.07, "note": "slow"}
    dear = TIMES | {"preview": dearest}
    told = " ".join(sentences(equal_time(views, dear, "all")))
    assert "1 sample a pixel" in told and "longer than the network" in told and "slow." in told
    untraced = [dataclasses.replace(view, scores={NETWORK: view.scores[NETWORK]}) for view in views]
    own, line = sentences(equal_time(untraced, TIMES, "all"))
    assert line.endswith("is not shown: none of the judged views could be traced.")
    lacking = TIMES | {"preview": None, "missing": "no tracer here"}
    page = evaluation_page(record(views, {}, equal_time(views, lacking, "all")))
    assert own in page and "is not shown: no tracer here." in page
    assert "own time" not in evaluation_page(record(views, {}))
    alone = draw_sheet(sheet_views(dataclasses.replace(contest, tracer=None), views), ("title",))
    shown = sheet_views(contest, views)
    # the target went through float32 logarithms
    np.testing.assert_allclose(
        shown[1].extra_rgb[CAPTION], shown[1].target_rgb, rtol=1e-5, atol=1e-6
    )
    assert draw_sheet(shown, ("title",)).width > alone.width


FILTERS: tuple[Filter, ...] = ("fast", "high")
LADDER = tuple(1 << step for step in range(13))


def test_it_is_judged_on_no_more_views_than_asked_from_all_over_the_split() -> None:
    for most, scenes, judged in [(64, 10, 10 * 2), (10, 10, 10), (4, 10, 4), (1, 10, 1)]:
        with case(most):
            every, first = spread_views(most, scenes)
            numbers = [number for number in range(0, scenes, every) for view in range(2)[:first]]
            assert len(numbers) == judged <= most
            assert max(numbers) >= scenes // 2 or most == 1
            views = "all views" if most == 64 else "the first view"
            assert spread_text(every, first, 2).startswith(f"{views} of ")
            assert ("each scene" in spread_text(every, first, 2)) == (most >= scenes)


class Clocked(RendererHere):
    """Renderer that says what it takes; loading takes longest in the first round."""

    name = "clocked"
    resolution = 16

    def __init__(self, further_s: float, *, dark: str = "", lacking: str = "") -> None:
        black = np.zeros((16, 16, 3), np.float32)
        self._picture = Rendered(radiance_rgb=black, cpu_seconds=further_s)
        self.loads = 0
        self._dark = dark
        self._lacking = lacking

    def load(self, scene: Scene, name: str) -> SceneHere:
        if self._lacking:
            raise TrilightError(self._lacking)
        if name == self._dark:
            raise Unrenderable(f"{name}: nothing shines")
        self.loads += 1
        loading_s = [100.0, 3.0, 5.0, 4.0][(self.loads - 1) % 4]
        return SceneHere(render_image=lambda _: self._picture, cpu_seconds=loading_s)


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
    assert times["scenes"] == 2 and times["missing"] == ""
    assert times["preview"] | {"first_s": 0} == {
        "samples": 4, "denoiser": "high", "first_s": 0, "further_s": 5.6, "note": "slow",
    }  # fmt: skip
    tried = [level for level, each in previews.items() if isinstance(each, Clocked) and each.loads]
    assert tried == [*((spp, denoiser) for spp in (1, 2, 4) for denoiser in FILTERS), (8, "fast")]
    least = time_both(Clocked(0.5), previews, samples)
    least_level = least["preview"]["samples"], least["preview"]["denoiser"]
    assert least_level == (1, "fast"), "where nothing fits, the cheapest is shown"


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
            assert times["preview"] is None and times["missing"] == said
            assert times["network_further_s"] == 6.0 and times["scenes"] == 1
    with pytest.raises(TrilightError, match="resolution is 20"):
        time_both(Clocked(1.0, lacking="resolution is 20"), {}, [sample])
