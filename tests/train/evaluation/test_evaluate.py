"""The evaluation: its figures, its rivals, its parts, and the command as a whole."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import flip_evaluator
import numpy as np
import pytest
import torch
from PIL import Image

from infra import judging
from model.inference import light_groups
from model.renderformer import RenderFormer
from model.scene_tensors import scene_tensors
from model.weights import encode_weights
from pipeline.presets.frozen_v1 import PRESETS_FOR_JUDGING
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.metrics import psnr_log_db
from storage.records.material import ROUGHNESS
from storage.seeds import rng_for
from tests.command_line import expect_mistake, expect_output
from tests.model.kit import awake, tiny_config
from tests.pipeline.renders.scene_kit import join, light, material, quad
from tests.train.kit import eval_config, tiny_run
from tests.train.loss.test_training_loss import small_weights
from tests.train.toy import toy_sample, toy_scene, write_toy_dataset
from train.data.scenes import training_scene
from train.evaluation.cost_charts import plot_excursions
from train.evaluation.evaluate import (
    GROUPED,
    TRACER,
    EvalConfig,
    grouped_pictures,
    judge_views,
    make_baselines,
    rows_of_sheets,
)
from train.evaluation.metrics import (
    METRICS,
    NETWORK,
    JudgedView,
    by_group,
    hdr_flip,
    picture_scores,
    scene_facts,
    summarize_views,
)
from train.evaluation.options import EvaluationOptions
from train.evaluation.report_pages import BENCHMARK, evaluation_page, record
from train.evaluation.validation import (
    MEDIAN,
    NEAREST,
    Baselines,
    median_picture,
    predict,
    validation_scene,
)
from train.loop.train_state import new_state
from train.loss.training_loss import Lpips


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("weights") / "model.safetensors"
    path.write_bytes(encode_weights(new_state(tiny_run()).model))
    return str(path)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_toy_dataset(tmp_path_factory.mktemp("toy"), train=5, validation=3, per_shard=3)


def contest(dataset: Dataset, network: RenderFormer | None = None) -> EvalConfig:
    shards = open_training_data([str(dataset.folder.root)]).split("train")
    return eval_config(dataset, network, baselines=make_baselines(shards, 16))


def test_hdr_flip_is_the_packages_and_what_cannot_be_measured_is_no_number() -> None:
    rng = rng_for(0, "flip")
    target = rng.uniform(0, 4, (24, 24, 3)).astype(np.float32)
    worse = np.maximum(target + rng.normal(0, 0.5, target.shape), 0)
    _, expected, _ = flip_evaluator.evaluate(target, worse.astype(np.float32), "HDR")
    assert hdr_flip(worse, target) == pytest.approx(float(expected))
    assert hdr_flip(target, target) == 0
    assert 0.05 < float(expected) < 1
    assert hdr_flip(worse, np.zeros_like(target)) is None
    picture = rng_for(0, "picture").uniform(0, 2, (16, 16, 3))
    hits = np.ones((16, 16), bool)
    without = picture_scores(picture, picture, hits, None)
    assert list(without) == list(METRICS)
    assert without["lpips"] is None
    assert (without["psnr_log_db"], without["ssim"], without["log_l1"]) == (100.0, 1.0, 0.0)
    with_weights = picture_scores(picture * 0.5, picture, hits, Lpips(*small_weights()))
    assert with_weights["lpips"] is not None and with_weights["lpips"] > 0


def test_rivals_are_the_median_and_the_closest_training_picture() -> None:
    scenes = [training_scene(toy_sample(index), 16) for index in range(5)]
    rivals = Baselines(scenes)
    target = 10 ** scenes[3].target_VRR3[1].double().numpy() - 1
    shown = rivals.pictures(target)
    # half floats of log10(1 + radiance) below 1: 2^-11 of it
    np.testing.assert_allclose(shown[NEAREST], target, rtol=5e-3, atol=2e-3)
    median = median_picture([scene.target_VRR3.numpy() for scene in scenes])
    np.testing.assert_allclose(shown[MEDIAN], median, rtol=5e-3, atol=2e-3)


def test_every_view_is_judged_beside_its_rivals(dataset: Dataset) -> None:
    done: list[None] = []
    rows = judge_views(contest(dataset), lambda: done.append(None))
    assert len(done) == 3 and [(row.key, row.view) for row in rows] == [
        (f"{scene:09d}", view) for scene in (5, 6, 7) for view in (0, 1)
    ]
    for row in rows:
        assert set(row.scores) == {NETWORK, MEDIAN, NEAREST}
        assert row.floors["psnr_log_db"] == 100.0 and row.floors["log_l1"] == pytest.approx(1e-5)
        score = row.scores[NETWORK]["psnr_log_db"]
        assert score is not None and row.gap("psnr_log_db") == pytest.approx(100 - score)
        similarity = row.scores[NETWORK]["ssim"]
        assert similarity is not None and row.gap("ssim") == pytest.approx(1 - similarity, abs=1e-6)
        assert row.gap("lpips") is None
    few = dataclasses.replace(contest(dataset), most_scenes=1)
    assert len(judge_views(few, lambda: None)) == 2
    with pytest.raises(TrilightError, match="resolution 24: expected a divisor of 32"):
        judge_views(dataclasses.replace(contest(dataset), resolution=24), lambda: None)


def row(number: int, **changes: object) -> JudgedView:
    scores = {name: 30.0 + number for name in METRICS} | {"lpips": None, "log_l1": 0.1}
    base = JudgedView(
        key=f"{number:09d}",
        view=0,
        template="box",
        num_triangles=100,
        num_lights=1,
        roughness=0.3,
        excursion=None,
        floors={"psnr_log_db": 40.0, "log_l1": 0.02},
        scores={NETWORK: scores},
    )
    return dataclasses.replace(base, **changes)  # type: ignore[arg-type]


def test_parts_are_ordered_and_a_summary_shows_the_bad_ones_and_the_noise() -> None:
    """Parts hold every view."""
    rows = [
        row(0, num_triangles=5000, num_lights=9, roughness=0.01),
        row(1, num_triangles=256, template="wall"),
        row(2, num_triangles=257, num_lights=3),
        row(3, num_triangles=1200),
    ]
    groups = by_group(rows)
    assert list(groups["triangles"]) == [
        "up to 256",
        "over 256, up to 512",
        "over 1024, up to 1536",
        "over 4096",
    ]
    assert list(groups["lights"]) == ["up to 1", "over 2, up to 4", "over 8"]
    assert list(groups["smoothest roughness"]) == ["up to 0.1", "over 0.25, up to 0.5"]
    assert {name: part["views"] for name, part in groups["template"].items()} == {
        "box": 3,
        "wall": 1,
    }
    rows = [row(number) for number in range(11)]
    found = summarize_views(rows)
    assert found["psnr_log_db"]["median"] == 35.0
    assert found["psnr_log_db"]["worse_5_percent"] == pytest.approx(30.5)
    assert found["psnr_log_db"]["median_worse_than_noise"] == 5.0
    assert found["log_l1"]["median_worse_than_noise"] == pytest.approx(0.08)
    assert found["lpips"] == dict.fromkeys(found["lpips"], None)
    assert found["near_floor"] == pytest.approx(4 / 11)  # 37 to 40 dB of 40
    partly = [*rows, row(11, scores={NETWORK: rows[0].scores[NETWORK] | {"lpips": 0.5}})]
    assert summarize_views(partly)["lpips"]["median"] is None, "never a median of another set"


def test_another_scenes_triangles_and_what_swapping_costs_are_told(dataset: Dataset) -> None:
    for config in (tiny_config(), tiny_config(demodulated=True, hit_rays=1)):
        judging = contest(dataset, awake(config, torch.float32))
        rows, samples = judge_views(judging, lambda: None), list(judging.samples())
        assert [view.swapped_psnr_log_db is None for view in rows] == [True] * 2 + [False] * 4
        before, judged = samples[1], validation_scene(samples[2], judging.resolution)
        seen = before.scene.with_cameras(samples[2].scene.c2w, samples[2].scene.fov_deg)
        mixed = training_scene(dataclasses.replace(samples[2], scene=seen), judging.resolution)
        shown = predict(judging.network, mixed.tensors, judging.resolution)
        for view, picture, target in zip(rows[4:], shown, judged.target_VRR3, strict=True):
            assert view.swapped_psnr_log_db == psnr_log_db(picture, target)
    swapped = [None, 28.0, 20.0, 34.0]
    rows = [row(0, swapped_psnr_log_db=value) for value in swapped]
    loss = record(rows, {})["swapped scenes"]
    assert loss["views"] == 3 and loss["median_db"] == 2.0  # 30 less 28, 20 and 34
    assert loss["mean_db"] == pytest.approx(8 / 3) and loss["share_lost"] == pytest.approx(2 / 3)
    assert "loses 2.00 dB" in evaluation_page(record(rows, {}))
    assert record(rows[:1], {})["swapped scenes"] is None


def test_worst_median_and_excursions_are_found_and_plotted(tmp_path: Path) -> None:
    """Facts come from the scene."""
    sample = toy_sample(0)
    provenance = {"template": "toy", "excursion": {"axis": "lights", "value": 16}}
    scene = sample.scene.with_provenance(provenance)
    facts = scene_facts(dataclasses.replace(sample, scene=scene))
    assert facts["excursion"] == ("lights", 16.0) and facts["template"] == "toy"
    *surfaces, _lamp = scene.materials[:, ROUGHNESS].tolist()
    assert (facts["num_lights"], facts["roughness"]) == (1, min(surfaces))
    rows = [row(number, excursion=("lights", 16.0 + number % 3)) for number in range(30)]
    rows.append(row(40, excursion=("fov_deg", 90.0)))
    chosen = rows_of_sheets(rows)
    assert [view.key for view in chosen["worst"]] == [f"{number:09d}" for number in range(8)]
    assert f"{15:09d}" in [view.key for view in chosen["median"]]
    assert [view.key for view in chosen["worst of each axis"]] == [f"{40:09d}", f"{0:09d}"]
    assert [*rows_of_sheets([row(0)])] == ["worst", "median"]
    assert plot_excursions(tmp_path / "none.png", [row(0)]) == 0
    assert not (tmp_path / "none.png").exists()
    rows = [row(k, excursion=(axis, 10.0**k)) for axis in ("a", "b", "c", "d") for k in range(3)]
    assert plot_excursions(tmp_path / "some.png", rows) == 4
    with Image.open(tmp_path / "some.png") as picture:
        assert min(picture.size) > 400


def test_the_page_prints_na_escapes_text_and_puts_the_benchmark_beside_the_paper() -> None:
    page = evaluation_page(record([row(0, template="a|b<c>")], {"data": "x_y"}))
    assert "a\\|b&lt;c&gt;" in page and "x\\_y" in page
    (line,) = [line for line in page.splitlines() if line.startswith("| network |")]
    assert "| n/a |" in line and "`lpips` (lower is better)" in page
    assert record([row(0)], {"build": "smoke"})["published"] is None
    page = evaluation_page(record([row(0)], {"build": BENCHMARK}))
    assert BENCHMARK in PRESETS_FOR_JUDGING
    assert "| 29.77 | 0.9526 | 0.0551 | 0.1751 |" in page
    assert "| here: network | 30.00 | 30.0000 | n/a | 30.0000 |" in page
    assert "400 scenes" in page and "256 x 256" in page


def test_many_lights_are_judged_in_one_pass_and_in_groups(dataset: Dataset) -> None:
    network = new_state(tiny_run()).model
    scene = toy_scene(0)
    assert not grouped_pictures(network, scene, 16), "one light is one group"
    floor = quad([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material(diffuse=0.5))
    lamps = [light([[x, 0, 2], [x + 0.05, 0, 2], [x, 0.05, 2]], 9.0) for x in np.arange(20) / 10]
    many = join([floor, *lamps]).with_cameras(scene.c2w, scene.fov_deg)
    grouped = grouped_pictures(network, many, 16)[GROUPED]
    assert grouped is not None and grouped.shape == (2, 16, 16, 3)
    # by hand: every group's picture times its share, the same sums in another order
    expected = sum(
        fraction * predict(network, scene_tensors(alone), 16)
        for alone, fraction in light_groups(many, 8)
    )
    np.testing.assert_allclose(grouped, expected, rtol=1e-5, atol=1e-6)
    alone, scores = row(0), row(1).scores[NETWORK]
    both = row(1, scores={NETWORK: scores, GROUPED: scores | {"ssim": 0.5}})
    assert record([alone], {})["light passes"] is None
    found = record([alone, both], {})
    assert list(found["contestants"]) == [NETWORK], "a column is of all views"
    assert found["light passes"]["groups"]["views"] == 1
    page = evaluation_page(found)
    assert "| groups | 1 | 31.00 | 31.00 | 31.00 | 0.5000 |" in page, page


def test_as_many_scenes_are_announced_as_are_judged(dataset: Dataset) -> None:
    shards = open_training_data([str(dataset.folder.root)]).split("train")
    every = dataclasses.replace(contest(dataset), shards=shards)
    for most in (1, 3, 4, 99):  # of five scenes in two shards
        some = dataclasses.replace(every, most_scenes=most)
        assert some.num_scenes == len(list(some.samples())) == min(most, 5)


def test_no_report_takes_the_place_of_another_networks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And that of a run is beside it."""
    monkeypatch.setattr(judging, "evaluation_page", str)
    for name in ("rows_of_sheets", "sheet_views"):
        monkeypatch.setattr(judging, name, lambda *more: {})

    def written(digest: str) -> str:
        figures = {"about": {"network sha256": digest}, "path tracer": {"preview": None}}
        told: Any = SimpleNamespace(record=figures, views=(), contest=SimpleNamespace())
        return judging.write_judgement(told, tmp_path / "evaluation").name

    assert [*map(written, "aba")] == ["evaluation", "evaluation-2", "evaluation"]
    (tmp_path / "evaluation-2" / "evaluation.json").write_text("[" * 9)
    assert written("b") == "evaluation-3"
    run = tmp_path / "runs" / "mine"
    (run / "checkpoints").mkdir(parents=True)
    (run / "settings.json").touch()
    places = [
        EvaluationOptions(checkpoint=str(checkpoint), data=("d",)).report_folder
        for checkpoint in (run, run / "model.safetensors", run / "checkpoints/9.safetensors")
    ]
    assert places == [run / "evaluation"] * 3
    assert EvaluationOptions(checkpoint="builtin:", data=("d",)).report_folder == Path("evaluation")


def test_the_command_writes_report_and_sheets(
    dataset: Dataset, weights: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    data = ["--data", str(dataset.folder.root)]
    command = ["evaluate", weights, *data, "--split", "validation", "--out", str(out)]
    printed = expect_output(*command, "--json", "--resolution", "16", "--tracer-views", "0")
    found = json.loads((out / "evaluation.json").read_text())
    assert found["contestants"] == json.loads(printed[printed.index("{") :])["contestants"]
    assert len(found["views"]) == 6
    assert "## By template" in (out / "evaluation.md").read_text()
    for name in ("worst.png", "median.png"):
        with Image.open(out / name) as sheet:
            assert min(sheet.size) > 200
    monkeypatch.setenv("TRILIGHT_VARIANT", "none_such")
    few = [*command, "--most-scenes", "1", "--tracer-views", "1"]
    shown = expect_output(*few, COLUMNS="160")
    (scores,) = [line.split() for line in shown.splitlines() if "psnr_log_db" in line.split()[:1]]
    assert len(scores) == 1 + len(found["contestants"])  # a column for each
    assert "The path tracer in that time is not shown: TRILIGHT_VARIANT is" in shown
    assert "is not shown: TRILIGHT" in (out / "evaluation.md").read_text()
    missing = expect_mistake("evaluate", tmp_path / "no", *data)
    assert "no such file or folder" in missing
    assert "the test split holds no scene" in expect_mistake("evaluate", weights, *data)


@pytest.mark.slow("references")
def test_the_command_shows_the_path_tracer_in_the_networks_time(
    dataset: Dataset, weights: str, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    data = ["--data", str(dataset.folder.root), "--split", "validation"]
    told = expect_output("evaluate", weights, *data, "--out", out)
    found = json.loads((out / "evaluation.json").read_text())
    assert TRACER in found["contestants"] and found["path tracer"]["views"] == 6
    assert found["path tracer"]["network_further_s"] > 0 and "and the path tracer" in told
    with Image.open(out / "worst.png") as sheet:
        assert sheet.width > 1500, "five pictures a view, two views a line"
