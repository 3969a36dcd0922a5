"""Every experiment: figures that are known beforehand, and its whole run on toy scenes."""

import dataclasses
import itertools
import json
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest import mock

import numpy as np
import pytest
import torch

from infra.bench.context import write_copies
from infra.bench.experiments import methods
from infra.bench.experiments.calibration import LOOKS
from infra.bench.experiments.cycles import agreement_figures
from infra.bench.experiments.frontier import cost_at_error
from infra.bench.experiments.gpu import EXPERIMENT as GPU
from infra.bench.experiments.gpu import NETWORKS
from infra.bench.experiments.growth import EXPERIMENT, WORK, measure_work, session_bytes
from infra.bench.experiments.loader import LAYOUTS, read_figures, unpacking_figures
from infra.bench.experiments.meshes import BUDGET_GROUP, CURVE, METHOD_GROUP
from infra.bench.experiments.paired_training import SIDE_A, SIDE_B, scene_of, settings_of
from infra.bench.workloads import cycles as environment
from infra.bench.workloads import gpu_steps
from infra.bench.workloads.cycles import installed_python
from infra.bench.workloads.gpu_steps import picture_figures, step_figures, step_settings
from infra.bench.workloads.named_scenes import given_scenes
from infra.bench.workloads.traced_pictures import load_or_render_reference
from infra.bench_options import BenchOptions
from infra.render.raw_references import RawReference
from pipeline.isolation import IsolatedChild
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.records.sample import encode_sample
from tests.for_each import case
from tests.infra.bench.test_harness import TINY, measured_rows
from tests.train.toy import toy_sample, toy_scene, write_toy_dataset
from train.presets import TRAINING_PRESETS, training_preset

PX = 64


def test_noise_is_no_difference_and_another_picture_is() -> None:
    rng = np.random.default_rng(0)
    truth = np.linspace(0.05, 0.5, PX * PX * 3).reshape(PX, PX, 3)

    def noisy(picture: np.ndarray) -> np.ndarray:
        return np.maximum(picture + rng.normal(0, 0.01, picture.shape), 0)

    ours = np.stack([noisy(truth), noisy(truth)])

    def figures(theirs: np.ndarray) -> dict[str, float]:
        return agreement_figures(ours, np.stack([noisy(theirs), noisy(theirs)]))

    same, mirrored = figures(truth), figures(truth[::-1])
    assert same["pixels_db"] > same["seeds_db"], "our mean of two is less noisy than one of theirs"
    assert same["noiseless_db"] > same["pixels_db"] + 6
    assert abs(same["brightness"]) < 1
    assert mirrored["pixels_db"] < same["pixels_db"] - 5
    assert figures(1.1 * truth)["brightness"] == pytest.approx(100 / 1.1 - 100, abs=1)


def test_json_of_other_kinds_is_no_scene_of_the_user(tmp_path: Path) -> None:
    template: dict[str, Any] = {"objects": {"a": {}}}
    scene = {**template, "cameras": [{}]}
    for name, record in (("2", scene), ("10", scene), ("template", template), ("list", [1])):
        (tmp_path / f"{name}.json").write_text(json.dumps(record))
    (tmp_path / "cut.json").write_text("{")
    assert list(given_scenes(tmp_path)) == ["2.json", "10.json"] and not given_scenes(None)
    (tmp_path / "others").mkdir()
    (tmp_path / "template.json").rename(tmp_path / "others" / "template.json")
    for folder in (tmp_path / "others", tmp_path / "none"):
        with pytest.raises(TrilightError, match=f"^--scenes: {folder}: .*expected"):
            given_scenes(folder)


@pytest.mark.slow("benchmarks")
def test_every_kind_of_scene_agrees(tmp_path: Path) -> None:
    if installed_python() is None:
        pytest.skip("Blender is not installed: trilight bench cycles installs it")
    found = measured_rows("cycles", tmp_path)
    assert list(found) == ["plain", "textured", "sky", "object"]
    of_object = found["object"].values
    assert of_object["objects: that of Cycles denoised, dB"] > 25
    assert (
        of_object["objects: true error of ours, dB"]
        > of_object["objects: stated over them, dB"] - 2
    )
    for row in found.values():
        assert row.values["means of 8 x 8, dB"] > 25, "64 samples each; another scene has below 20"


@pytest.mark.slow("benchmarks")
def test_every_look_of_a_layout_is_a_row(tmp_path: Path) -> None:
    found = measured_rows("calibration", tmp_path)
    assert list(found) == [f"{px} px, {spp} samples" for px, spps in LOOKS.items() for spp in spps]
    assert all(row.values["true, median millionths"] > 0 for row in found.values())


LEVELS = [(float(1 << k), 2.0**k, 30 + 3.0 * k) for k in range(5)]
"""Samples, core-seconds and dB."""


def test_equal_error_lies_between_the_levels() -> None:
    for _, core_s, db in LEVELS:
        assert cost_at_error(LEVELS, db) == (core_s, 0)
    core_s, bound = cost_at_error(LEVELS, 34.5)
    assert not bound and core_s == pytest.approx(2**1.5, rel=0.1)
    assert cost_at_error(LEVELS, 50.0) == (LEVELS[-1][1], 1)
    assert cost_at_error(LEVELS, 20.0) == (LEVELS[0][1], -1)


@pytest.mark.slow("benchmarks")
def test_our_renderer_beside_plain_mitsuba(tmp_path: Path) -> None:
    found = measured_rows("frontier", tmp_path)
    db = {name: row.values["psnr_log_db, dB"] for name, row in found.items()}
    plain = [db[f"mitsuba multijitter {spp}"] for spp in (256, 64)]
    assert plain[0] > plain[1] > 20  # a picture of something else has below 20
    ours = found["trilight 46 dB"].values
    assert ours["Mitsuba's cost at equal error, times"] > 0
    assert 0 <= ours["log: over 1 dB worse than stated, %"] <= 100
    assert found["trilight 40 dB, 256 px"].on_front is None, "another width is no choice here"


CPU = torch.device("cpu")


def test_every_preset_has_its_own_size_on_a_gpu_and_a_small_one_here() -> None:
    for run in TRAINING_PRESETS:
        with case(run):
            settings = training_preset(run)
            on_gpu = step_settings(run, torch.device("cuda"))
            assert on_gpu == dataclasses.replace(settings, from_weights=False)
            small = step_settings(run, CPU)
            assert small.model.view_stage == settings.model.view_stage
            assert small.model.head == settings.model.head
            assert (small.loss, small.precision) == (settings.loss, settings.precision)


def test_no_memory_has_no_figures_and_no_gpu_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = mock.Mock(side_effect=torch.OutOfMemoryError("CUDA out of memory"))
    monkeypatch.setattr(gpu_steps, "drawn_batch", drawn)
    assert step_figures("smoke", 1, CPU) == {}
    assert drawn.call_args.args[1] == 1, "fewer scenes were tried, down to one"
    monkeypatch.setattr(gpu_steps, "picture_figures", mock.Mock(return_value={"db": 100.0}))
    notes: list[str] = []
    context = SimpleNamespace(options=BenchOptions(device="cpu"), note=notes.append)
    point = next(each for each in GPU.points(TINY, context.options) if "picture" in each.name)
    assert point.measure and point.measure(cast(Any, context), "round 1") == {"db": 100.0}
    assert "without a GPU a picture is compared with itself" in notes


@pytest.mark.slow("benchmarks")
def test_a_picture_is_near_the_processors_and_another_network_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for network in NETWORKS:
        with case(network):
            found = picture_figures(network, "bfloat16", CPU)
            assert found["db"] > 45 and found["ms"] > 0, "rounded, as on a device"
    wrong = mock.Mock(
        side_effect=[gpu_steps._first_view(name, CPU, "float32") for name in NETWORKS]
    )
    monkeypatch.setattr(gpu_steps, "_first_view", wrong)
    assert picture_figures("builtin:hits", "float32", CPU)["db"] < 40


@pytest.mark.slow("benchmarks")
def test_steps_are_timed() -> None:
    for run in ("smoke", "finetune", "hits"):
        with case(run):
            figures = step_figures(run, 1, CPU)
            assert figures["ms"] > 0 and figures["views_per_s"] > 0


def test_sizes_grow_fourfold_up_to_the_most() -> None:
    points = EXPERIMENT.points(dataclasses.replace(TINY, growth=12), BenchOptions())
    for name, work in WORK.items():
        sizes = [point.size or 0 for point in points if point.kind.startswith(f"{name},")]
        assert sizes[0] == work.least and sizes[-1] <= work.most < 4 * sizes[-1], name
        assert len(sizes) > 1 and all(b == 4 * a for a, b in itertools.pairwise(sizes)), name


def test_memory_is_that_of_a_session() -> None:
    code = "data = bytearray(60_000_000); data[::4096] = b'x' * len(data[::4096]); input()"
    with subprocess.Popen(
        [sys.executable, "-c", f"{code}"], stdin=subprocess.PIPE, start_new_session=True
    ) as process:
        found = 0
        for _ in range(200):
            found = max(found, session_bytes(process.pid))
            if found > 60e6:
                break
            time.sleep(0.05)
        process.communicate(b"\n")
    assert 60e6 < found < 120e6
    assert session_bytes(process.pid) == 0


@pytest.mark.slow("benchmarks")
def test_every_kind_of_work_is_done_at_its_smallest_size(tmp_path: Path) -> None:
    sample = tmp_path / "sample"
    sample.mkdir()
    for name, data in encode_sample(toy_sample(0, resolution=32), "compact").items():
        (sample / name).write_bytes(data)
    for row, (name, work) in enumerate(WORK.items()):
        with case(name):
            folder = tmp_path / str(row)
            folder.mkdir()
            found = measure_work(name, work.least, folder)
            assert found["seconds"] > 0 and found["peak_bytes"] > 20e6


def test_our_profiles_take_fewer_bytes_than_the_published_layout(tmp_path: Path) -> None:
    samples = [toy_sample(number, resolution=32) for number in range(2)]
    found = {layout: unpacking_figures(samples, layout, tmp_path) for layout in LAYOUTS}
    sizes = {layout: figures["bytes"] for layout, figures in found.items()}
    assert sizes["compact"] <= sizes["lossless"] < sizes["HDF5 float16"] < sizes["HDF5 float32"]
    assert all(figures["sample_ms"] > 0 for figures in found.values())


def test_copies_are_read_by_any_number_of_threads(tmp_path: Path) -> None:
    members = [
        encode_sample(toy_sample(number, resolution=64, views=4), "compact") for number in range(2)
    ]
    count = write_copies(tmp_path, members, copies=4, per_shard=3)
    data = open_training_data([str(tmp_path)])
    assert count == 8 and len(data.split("train").names) == 3
    for threads in (0, 2):
        assert read_figures(data, count, threads)["sample_ms"] > 0


@pytest.mark.slow("benchmarks")
def test_the_loader_on_rendered_scenes(tmp_path: Path) -> None:
    found = measured_rows("loader", tmp_path)
    assert found["unpack, compact"].point.default
    assert found["batches, 2 threads"].values["samples a second"] > 1


@pytest.mark.slow("benchmarks")
def test_a_larger_budget_is_nearer(tmp_path: Path) -> None:
    found = measured_rows("meshes", tmp_path)
    distance = "distance to the source, p99, % of the diagonal"
    few, most = (found[f"{BUDGET_GROUP}, {budget}"].values for budget in (CURVE[0], CURVE[-1]))
    assert most[distance] < few[distance]
    assert most["picture, psnr_log_db"] > few["picture, psnr_log_db"]
    default = [name for name, row in found.items() if row.point.default]
    assert default == [f"{METHOD_GROUP}, faithful"]


@pytest.mark.slow("benchmarks")
def test_methods_come_nearer_with_samples_and_with_what_is_traced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a hundred objects of the benchmark take minutes to prepare, and one scene uses few of them
    monkeypatch.setattr(methods, "BENCHMARK", "builtin:12")
    monkeypatch.setattr(methods, "WIDTHS", (32,))
    found = measured_rows("methods", tmp_path)
    db = {name: row.values["psnr_log_db, dB"] for name, row in found.items()}
    assert db["32 px, 16 samples, fast"] > db["32 px, 1 sample, fast"]
    cost = {name: row.values["a further view, core-s"] for name, row in found.items()}
    assert cost["32 px, direct light, no network"] < cost["32 px, all traced light, no network"]
    # of one row they are milliseconds, which vary by more than loading a tiny scene takes
    firsts = [row.values["a scene's first view, core-s"] for row in found.values()]
    assert sum(firsts) > sum(cost.values())
    assert not found["32 px, network builtin:"].intervals and len(found) == 10


def test_sides_differ_in_what_is_asked_for_alone_and_a_scene_is_one_cluster_of_seeds() -> None:
    options = BenchOptions(changes={"scenes_per_step": 2}, set_b={"learning_rate": 1e-3})
    a, b = (settings_of(side, 3, TINY, options) for side in (SIDE_A, SIDE_B))
    assert a != b and dataclasses.replace(a, learning_rate=1e-3) == b
    assert (a.seed, a.num_steps, a.scenes_per_step) == (3, TINY.steps, 2)
    longer = BenchOptions(changes={"num_steps": 7})
    assert settings_of(SIDE_A, 0, TINY, longer).num_steps == 7
    with pytest.raises(TrilightError, match="--run names 2 presets; expected one"):
        settings_of(SIDE_A, 0, TINY, BenchOptions(run=("smoke", "pretrain")))
    assert scene_of("seed 0, scene 4") == scene_of("seed 1, scene 4") != scene_of("seed 1, scene 5")


@pytest.mark.slow("benchmarks")
def test_equal_sides_differ_by_nothing_and_a_step_less_by_something(tmp_path: Path) -> None:
    data = tmp_path / "toy"
    write_toy_dataset(data, train=4, validation=2, resolution=32)
    shared = {"resolution": 16, "scenes_per_step": 2, "views_per_scene": 2}
    options = BenchOptions(
        data=str(data), changes=shared, set_b={"learning_rate": 0.01}, seeds=1, device="cpu"
    )
    name = "more error than a, %"
    found = measured_rows("paired-training", tmp_path, options)
    assert found[SIDE_B].values[name] != 0 and SIDE_A in found
    assert name in found[SIDE_B].intervals and name not in found[SIDE_A].values
    same = dataclasses.replace(options, set_b={})
    assert measured_rows("paired-training", tmp_path, same)[SIDE_B].values[name] == 0


def test_an_interrupted_installation_does_not_count_and_what_fails_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    monkeypatch.setattr(environment, "PYTHON", "3.0")
    with pytest.raises(TrilightError, match=r"^Blender .*python3\.0 is not on the path.*\.$"):
        environment.blender_python()
    with pytest.raises(TrilightError, match=r"^Blender .*could not load it: no such wheel\.$"):
        environment._run("load it", ["sh", "-c", "echo first; echo no such wheel >&2; exit 3"])
    assert environment.installed_python() is None
    steps: list[str] = []

    def step(name: str, command: list[str]) -> None:
        steps.append(name)
        (tmp_path / "cycles" / f"bpy-{environment.BLENDER}").mkdir(parents=True, exist_ok=True)
        if len(steps) == 2:
            raise TrilightError("no index")

    monkeypatch.setattr(environment, "_base_python", lambda: "python")
    monkeypatch.setattr(environment, "_run", step)
    with pytest.raises(TrilightError):
        environment.blender_python()
    assert environment.installed_python() is None
    assert environment.blender_python() == environment.installed_python()
    assert len(steps) == 2 + 3  # began anew
    assert f"bpy=={environment.BLENDER} " in environment.LOCK.read_text()
    environment.blender_python()
    assert len(steps) == 2 + 3  # and is remembered


def test_a_view_is_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path))
    calls: list[Any] = []

    def make_up(*asked: Any) -> RawReference:
        calls.append(asked)
        return np.random.default_rng(len(calls)).random((2, 8, 8, 3))

    child, scene = cast(IsolatedChild, SimpleNamespace(call=make_up)), toy_scene(0)
    first = load_or_render_reference(child, scene, 8, 128)
    again = load_or_render_reference(child, scene, 8, 128)
    assert len(calls) == 1
    np.testing.assert_array_equal(first, again)
    assert first.dtype == np.float64 and not np.array_equal(*first)
    for other in (
        (scene, 8, 256),
        (scene, 16, 128),
        (toy_scene(1), 8, 128),
    ):
        load_or_render_reference(child, *other)
    assert len(calls) == 4, "other samples, width or scene is another reference"
