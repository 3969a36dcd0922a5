"""The table of small trainings: what is done stays done, budgets hold, and the fit is honest."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from infra.bench import training_jobs, training_table
from infra.bench.power_law import fit_power_law
from infra.bench.training_jobs import BASELINE, CHANGES, SCENES, SEEDS, Job, Plan, all_jobs
from infra.bench.training_plot import plot
from infra.bench.training_report import PAPER, mean_ratio, of_newest_data, reached, report_lines
from infra.bench.training_table import read_table, run_jobs
from storage.errors import TrilightError
from storage.seeds import rng_for
from storage.settings import settings_record
from tests.train.kit import TINY_MODEL
from tests.train.toy import write_toy_dataset


def job(**changes: object) -> Job:
    base = Job(plan="cpu", scenes=6, size="small", change=BASELINE, seed=0)
    return dataclasses.replace(base, **changes)  # type: ignore[arg-type]


def test_every_change_changes_something_and_only_that() -> None:
    jobs = all_jobs("cpu")
    assert len(jobs) == len(CHANGES) * len(SEEDS) * 2 * len(SCENES)
    assert len({one.name for one in jobs}) == len(jobs)
    assert len({one.digest() for one in jobs}) == len(CHANGES) * len(SEEDS) * 2
    base = settings_record(job().settings())
    for change in list(CHANGES)[1:]:
        record = settings_record(job(change=change).settings())
        differing = {name for name in base if record[name] != base[name]}
        assert differing, change
        assert len(differing) == 1 or change in ("paper-schedule", "muon-half")
    muon, half = (job(change=change).settings() for change in ("muon", "muon-half"))
    assert half.num_steps == muon.num_steps / 2 and half.muon_rate == muon.muon_rate
    with pytest.raises(TrilightError, match="plan 'tpu': no such plan; expected cpu or gpu"):
        all_jobs("tpu")


def test_a_power_law_is_found_again() -> None:
    counts = [60, 60, 240, 240, 960, 960]
    exact = fit_power_law(counts, [0.1 * n**-0.3 for n in counts])
    assert (exact.exponent, exact.factor) == (pytest.approx(0.3), pytest.approx(0.1))
    assert exact.exponent_low == pytest.approx(0.3) == pytest.approx(exact.exponent_high)
    assert exact.at(9600) == pytest.approx(0.1 * 9600**-0.3)
    with pytest.raises(ValueError, match="beyond 10 times the largest measured, 960"):
        exact.at(9601)
    with pytest.raises(ValueError, match="two different N"):
        fit_power_law([60, 60], [0.1, 0.2])
    assert math.isnan(fit_power_law([60, 240], [0.2, 0.1]).exponent_low)


def test_its_interval_holds_the_truth_as_often_as_it_says() -> None:
    counts = np.repeat([60.0, 240.0, 960.0], 2)
    rng = rng_for(0, "law")
    held = 0
    for _ in range(1000):
        errors = 0.1 * counts**-0.2 * np.exp(rng.normal(0, 0.05, 6))
        law = fit_power_law(list(counts), list(errors))
        held += law.exponent_low <= 0.2 <= law.exponent_high
    assert 920 < held < 980  # 950 expected, standard deviation 7: four of them


@pytest.mark.slow
def test_jobs_are_run_once_and_within_the_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Plan(sizes={"small": TINY_MODEL}, resolution=16, num_steps=100, scenes_per_step=3)
    monkeypatch.setitem(training_jobs.PLANS, "cpu", plan)
    dataset = write_toy_dataset(tmp_path / "data", train=12, validation=2, per_shard=3)
    table, work = tmp_path / "table.jsonl", tmp_path / "work"
    jobs = [job(), job(seed=1), job(scenes=12), job(scenes=12, seed=1), job(change="ema")]
    assert run_jobs(jobs, dataset, work, table, minutes=-1) == 0
    assert run_jobs(jobs[:1], dataset, work, table, minutes=9) == 1
    assert run_jobs(jobs, dataset, work, table, minutes=9) == 4
    assert run_jobs(jobs, dataset, work, table, minutes=9) == 0
    rows = read_table(table)
    assert [row["job"] for row in rows] == [one.name for one in jobs]
    assert [row["scenes"] for row in rows] == [6, 6, 12, 12, 6]
    assert rows[0]["scores"] != rows[1]["scores"] != rows[2]["scores"]
    lines = report_lines(rows)
    (ours,) = [line for line in lines if f"| {BASELINE} |" in line]
    assert "6 scenes" in lines[2] and ours.count("(") == 3
    (ema,) = [line for line in lines if "| ema |" in line]
    assert ", x" in ema and "n/a" in ema
    with pytest.raises(TrilightError, match="12 training scenes; expected at least 60"):
        run_jobs([job(scenes=60)], dataset, work, table, minutes=9)
    assert json.loads(table.read_text().splitlines()[0])["machine"]["cores"]


def test_steps_saved_are_read_off_the_curves() -> None:
    curve = [[100, 0.06], [200, 0.055], [300, 0.056], [400, 0.05]]
    assert [reached(curve, error) for error in (0.06, 0.0555, 0.05, 0.049)] == [
        100,
        200,
        400,
        math.inf,
    ]
    row = {
        "plan": "cpu", "size": "small", "scenes": 6, "seed": 0, "num_steps": 400, "curve": curve,
        "scores": {"log_l1": 0.05}, "median_scores": {"log_l1": 0.07}, "data_digest": "0" * 64,
    }  # fmt: skip
    paper = {**row, "scores": {"log_l1": 0.0555}}
    never = {**row, "change": "ema", "scores": {"log_l1": 0.06}, "curve": [[400, 0.06]]}
    lines = report_lines([{**row, "change": BASELINE}, {**paper, "change": PAPER}, never])
    assert "| ours | 1 | 100% | 0.901 (no interval) | 50% (50% to 50%) |" in lines
    assert "| ema | 1 | 100% | 1.081 (no interval) | never (never to never) |" in lines


def test_a_mean_ratio_holds_the_truth_as_often_as_it_says() -> None:
    rng = rng_for(0, "ratios")
    held = 0
    for _ in range(1000):
        _, low, high = mean_ratio(list(0.9 * np.exp(rng.normal(0, 0.05, 6))))
        held += low <= 0.9 <= high
    assert 920 < held < 980  # 950 expected, standard deviation 7: four of them
    assert mean_ratio([0.8, 1.25])[0] == pytest.approx(1.0)


def test_the_picture_has_a_panel_for_each_network(tmp_path: Path) -> None:
    base = {
        "plan": "cpu", "change": BASELINE, "seed": 0, "scores": {"log_l1": 0.05},
        "median_scores": {"log_l1": 0.07}, "data_digest": "0" * 64,
    }  # fmt: skip
    sizes = (("small", 1000), ("large", 5000))
    rows = [
        {**base, "size": size, "num_parameters": count, "scenes": scenes}
        for size, count in sizes
        for scenes in (60, 240)
    ]
    plot(rows, tmp_path / "two.png")
    plot(rows[:2], tmp_path / "one.png")
    with Image.open(tmp_path / "two.png") as two, Image.open(tmp_path / "one.png") as one:
        assert two.width == 2 * one.width


def test_only_the_set_that_was_used_last_is_compared() -> None:
    rows = [
        {"plan": plan, "data_digest": digest, "row": row}
        for row, (plan, digest) in enumerate((("cpu", "a"), ("gpu", "a"), ("cpu", "b")))
    ]
    assert [row["row"] for row in of_newest_data(rows)] == [1, 2]


def test_a_table_without_results_says_so(tmp_path: Path) -> None:
    assert report_lines(read_table(training_table.TABLE.with_name("none.jsonl"))) == [
        "No result yet."
    ]
