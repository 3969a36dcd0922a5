"""The sides differ in what is asked for alone, and pairs are of one seed and scene."""

import dataclasses
from pathlib import Path

import pytest

from infra.bench.experiments.paired_training import SIDE_A, SIDE_B, scene_of, settings_of
from infra.bench_options import BenchOptions
from storage.errors import TrilightError
from tests.infra.bench.bench_kit import TINY, measured_rows
from tests.train.toy import write_toy_dataset

RATE = {"learning_rate": 1e-3}


def test_the_sides_differ_in_what_is_asked_for_alone() -> None:
    options = BenchOptions(changes={"scenes_per_step": 2}, set_b=RATE)
    a, b = (settings_of(side, 3, TINY, options) for side in (SIDE_A, SIDE_B))
    assert a != b and dataclasses.replace(a, learning_rate=1e-3) == b
    assert (a.seed, a.num_steps, a.scenes_per_step) == (3, TINY.steps, 2)
    longer = BenchOptions(changes={"num_steps": 7})
    assert settings_of(SIDE_A, 0, TINY, longer).num_steps == 7
    with pytest.raises(TrilightError, match="--run names 2 presets; expected one"):
        settings_of(SIDE_A, 0, TINY, BenchOptions(run=("smoke", "pretrain")))


def test_a_scene_is_one_cluster_with_all_seeds() -> None:
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
