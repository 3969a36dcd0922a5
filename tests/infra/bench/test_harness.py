"""Laws of the harness: trials, fronts, a store that survives a kill, table and plot."""

import dataclasses
import json
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from infra.bench import run_benchmark as running
from infra.bench import stated_errors
from infra.bench.context import BenchContext
from infra.bench.experiment import (
    FULL,
    QUICK,
    Column,
    Experiment,
    Figures,
    Point,
    Run,
    begin_run,
    columns_of,
    every_experiment,
    experiment_of,
    read_runs,
)
from infra.bench.experiments.calibration import FIGURES, LOOKS, has_wide, use_of
from infra.bench.rows import Row, plot, rows_of, table_of
from infra.bench.run_benchmark import commit_text, machine_record, run
from infra.bench.stated_errors import (
    ALLOWED,
    Look,
    cross_fitted,
    filter_known,
    fit_metric,
    fit_weights,
    judge,
    largest_shift,
    main,
    read_looks,
    stated_by,
    stops,
    true_db,
)
from infra.bench_options import BenchOptions
from pipeline.renders.calibrated_error import load_statement, versions_of_pictures
from storage.errors import Rejected, TrilightError
from storage.metrics import mean_interval
from tests.command_line import trilight
from tests.for_each import case
from train.evaluation.cost_charts import COST_NOISE, on_front

TINY = dataclasses.replace(
    QUICK, scenes=1, resolution=32, max_spp=128, reference_spp=128, picture_px=64, objects=1,
    repeats=1, steps=2, held_out=2, growth=1, layouts=1,
)  # fmt: skip

calls: list[tuple[str, str]] = []
"""What the experiment below measured, in order."""
TOY_FIGURES = {"cheap": (1.0, 30.0), "default": (2.0, 40.0), "waste": (3.0, 35.0)}
"""Cost and error in decibels by point."""


def measure(point: str, context: BenchContext, trial: str) -> Figures:
    """Return made-up figures; the trial `bad` cannot be used, and `killed` ends the run."""
    if trial == "bad" and point == "default":
        raise Rejected("no_scene", "it has no light")
    calls.append((trial, point))
    if trial == "killed" and point == "waste" and not context.options.data:
        raise KeyboardInterrupt
    cost, db = TOY_FIGURES[point]
    late = 0.5 * (trial == "c")
    return {"core_s": cost + late, "db": db}


def experiment(*trials: str) -> Experiment:
    """Return three points that are measured in these trials."""
    return Experiment(
        name="made-up",
        title="Made up",
        cost=Column(name="core-seconds", figure="core_s", over="mean"),
        error=Column(name="psnr_log_db, dB", figure="db"),
        better="higher",
        columns=(
            Column(name="a second", figure="core_s", over="mean", then=lambda s: 1 / s),
            Column(name="more than default, dB", figure="db", over="pair"),
        ),
        points=lambda scale, options: [
            Point(
                name=name,
                measure=partial(measure, name),
                default=name == "default",
                kind="cheap ones" if name == "cheap" else "others",
                rival=None if name == "default" else "default",
            )
            for name in TOY_FIGURES
        ],
        trials=lambda scale, options: trials,
    )


def measured_rows(name: str, folder: Path, options: BenchOptions | None = None) -> dict[str, Row]:
    """Measure an experiment for real at the scale TINY; return its rows by point."""
    one, out = experiment_of(name), folder / f"{name}.jsonl"
    found = run(one, TINY, options or BenchOptions(), out)
    assert found.seconds is not None
    assert out.with_suffix(".png").stat().st_size > 5000
    return {row.point.name: row for row in rows_of(one, found)}


@pytest.fixture(autouse=True)
def same_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """The commit of a working tree may change while tests run; no plot is drawn."""
    calls.clear()
    here = machine_record("cpu")
    monkeypatch.setattr(running, "machine_record", lambda device: here)
    monkeypatch.setattr(running, "plot", lambda *_: None)


def measured(folder: Path, *trials: str, data: str | None = None) -> Run:
    one = experiment(*trials)
    return run(one, TINY, BenchOptions(data=data), folder / "made-up.jsonl")


def test_every_declaration_is_whole() -> None:
    found = every_experiment()
    assert sorted(found) == [
        "calibration", "cycles", "frontier", "gpu", "growth", "loader", "meshes", "methods",
        "paired-training", "relighting",
    ]  # fmt: skip
    for name, one in found.items():
        with case(name):
            columns = [column.name for column in columns_of(one)]
            assert len(set(columns)) == len(columns) and set(one.also_cost) <= set(columns)
            assert one.title
            for scale in (FULL, QUICK, TINY):
                points = one.points(scale, BenchOptions())
                names = {point.name for point in points}
                assert names and len(names) == len(points)
                assert {point.rival for point in points} <= {None, *names}
                trials = one.trials(scale, BenchOptions())
                assert trials and len(set(trials)) == len(trials)


def test_points_are_measured_in_turn_and_a_failed_trial_counts_for_none(tmp_path: Path) -> None:
    found = measured(tmp_path, "a", "b")
    assert calls == [(trial, point) for trial in ("a", "b") for point in TOY_FIGURES]
    assert found.whole_trials() == ["a", "b"]
    found = measured(tmp_path, "a", "bad", "c")
    assert found.whole_trials() == ["a", "c"]
    assert found.left_out == {"bad": "no_scene: it has no light"}
    with pytest.raises(TrilightError, match="no trial could be measured: no_scene"):
        measured(tmp_path / "none", "bad")


def test_columns_are_over_the_trials_and_pairs_have_their_interval(tmp_path: Path) -> None:
    one, found = experiment("a", "b", "c"), measured(tmp_path, "a", "b", "c")
    for trial, db in (("a", 28.0), ("b", 30.0), ("c", 35.0)):
        found.trials[trial]["cheap"] = {"core_s": 1.0 + 0.5 * (trial == "c"), "db": db}
    cheap, default, waste = rows_of(one, found)
    assert cheap.values["core-seconds"] == pytest.approx(3.5 / 3)
    assert cheap.values["a second"] == pytest.approx(3 / 3.5)
    assert cheap.cost_range == (1, 1.5)
    assert [row.on_front for row in (cheap, default, waste)] == [True, True, False]
    name = one.columns[1].name
    assert cheap.values[name] == pytest.approx((28 + 30 + 35) / 3 - 40)
    assert cheap.intervals[name] == mean_interval([-12.0, -10.0, -5.0], ["a", "b", "c"])
    assert name not in default.values, "the rival is not its own rival"
    assert waste.intervals[name] == (-5.0, -5.0)
    of_one_scene = dataclasses.replace(one, cluster=lambda trial: "one scene")
    low, high = rows_of(of_one_scene, found)[0].intervals[name]
    assert low == high == cheap.values[name], "intervals are over clusters"


def test_results_name_a_dataset_and_not_where_it_lies(tmp_path: Path) -> None:
    names = [
        measured(tmp_path, "a", data=f"/srv/someone/{folder}/set").plan["options"]["data"]
        for folder in ("here", "there")
    ]
    assert all(re.fullmatch(r"set \([0-9a-f]{8}\)", name) for name in names)
    assert len(set(names)) == 2 and "someone" not in (tmp_path / "made-up.jsonl").read_text()


def test_a_killed_run_resumes_where_it_was(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        measured(tmp_path, "a", "killed", "c")
    assert read_runs(tmp_path / "made-up.jsonl")[-1].seconds is None  # not ended
    calls.clear()
    with pytest.raises(KeyboardInterrupt):  # the same plan, which is killed again
        measured(tmp_path, "a", "killed", "c")
    assert calls[0] == ("killed", "cheap")
    calls.clear()
    measured(tmp_path, "a", "killed", "c", data="another plan")  # takes no figures of the first
    assert calls[0] == ("a", "cheap")


@settings(max_examples=30, deadline=None)  # each writes a dozen lines to the disk
@given(cut=st.integers(0, 900))
def test_whatever_is_left_of_a_file_can_be_resumed(
    cut: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A kill may cut the file anywhere; what was whole stays, and the run ends the same."""
    path = tmp_path_factory.mktemp("store") / "x.jsonl"
    wanted = {"a": {"p": {"x": 1.0}, "q": {"x": 2.0}}, "b": {"p": {"x": 3.0}, "q": {"x": 4.0}}}
    _resume(path, wanted)
    whole = path.read_bytes()
    path.write_bytes(whole[: min(cut, len(whole) - 1)])
    assert _resume(path, wanted).trials == wanted
    assert [json.loads(line) for line in path.read_text().splitlines()]


def _resume(path: Path, wanted: dict) -> Run:
    current = begin_run(path, {"points": [{"name": "p"}, {"name": "q"}], "trials": ["a", "b"]})
    for trial in current.missing_trials():
        for point, figures in wanted[trial].items():
            current.add(trial, point, figures)
    current.write(seconds=1.0, notes=["a note"])
    found = read_runs(path)[-1]
    assert found.seconds == 1.0 and found.notes == ["a note"] and not found.missing_trials()
    return found


def test_another_file_a_name_twice_and_what_is_missing_are_refused(tmp_path: Path) -> None:
    for text in ['{"key": 1}\n', "no json\n", "[]\n", '{"plan": {}}\n', "[" * 100_000 + "\n"]:
        with case(text):
            path = tmp_path / "other.jsonl"
            path.write_text(text)
            with pytest.raises(
                TrilightError, match="no rows of `trilight bench`.*expected a file that it wrote"
            ):
                read_runs(path)
    one = experiment("a")
    twice = dataclasses.replace(one, points=lambda *given: [*one.points(*given)] * 2)
    bare = dataclasses.replace(one, needs=("data",))
    for wrong, said in ((twice, "'cheap' is there twice"), (bare, "--data is not given; expected")):
        with pytest.raises(TrilightError, match=said):
            run(wrong, TINY, BenchOptions(), tmp_path / "x.jsonl")


def test_the_table_has_every_point_and_the_plot_every_kind(tmp_path: Path) -> None:
    one, found = experiment("a", "c"), measured(tmp_path, "a", "c")
    names, cheap, default, _ = table_of(one, found)
    assert names == ["setting", *(column.name for column in columns_of(one)), "front"]
    assert cheap == [
        "cheap",
        "1.25 (1.00 to 1.50)",
        "30.0",
        "0.80",
        "-10.0 (-10.0 to -10.0)",
        "yes",
    ]
    assert default[0] == "default *" and default[4] == ""
    path = tmp_path / "made-up.png"
    grown = dataclasses.replace(one, error=None)
    for number, each in enumerate((one, grown)):
        plot(each, found, path)
        with Image.open(path) as picture:
            assert picture.width > 300 and len(set(picture.convert("L").tobytes())) > 20, number
    for point in found.plan["points"]:
        point["size"] = 2.0 + len(point["name"])
    plot(grown, found, path)
    with Image.open(path) as picture:
        assert {(31, 119, 180), (255, 127, 14)} <= set(picture.convert("RGB").get_flattened_data())


def test_a_run_of_versions_resumes_on_other_machines_commits_and_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = dataclasses.replace(
        experiment("a", "killed"),
        versions=lambda options: {"denoiser": "1"},
        figures=("core_s", "db"),
    )
    out = tmp_path / "made-up.jsonl"
    with pytest.raises(KeyboardInterrupt):
        run(one, TINY, BenchOptions(), out)
    monkeypatch.setattr(running, "machine_record", lambda device: {"commit": "another"})
    resumed = run(one, TINY, BenchOptions(data="there"), out)
    assert resumed.whole_trials() == ["a", "killed"]
    assert [trial for trial, _ in calls].count("a") == len(TOY_FIGURES)
    assert resumed.trials["a"]["cheap"] == {"core_s": 1.0, "db": 30.0}
    other = dataclasses.replace(one, versions=lambda options: {"denoiser": "2"})
    assert run(other, TINY, BenchOptions(data="there"), out) is not resumed
    assert len(read_runs(out)) == 2


def test_all_are_listed_and_an_installed_trilight_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = trilight(["bench"])
    assert listed.exit_code == 0 and "paired-training" in listed.stdout
    monkeypatch.delitem(sys.modules, "infra.bench.experiment")
    monkeypatch.setitem(sys.modules, "infra.bench", None)
    done = trilight(["bench", "frontier"])
    assert done.mistake.startswith("bench: an installed Trilight has no experiments; expected a")


POINTS = st.lists(
    st.tuples(st.floats(0, 100), st.lists(st.floats(0.01, 100), min_size=2, max_size=2)),
    min_size=1,
    max_size=6,
)


@given(POINTS)
def test_what_is_not_on_the_front_is_dominated_by_what_is_no_worse(
    points: list[tuple[float, list[float]]],
) -> None:
    marks = on_front(points)
    assert any(marks)
    for mark, (error, costs) in zip(marks, points, strict=True):
        as_good = [
            other
            for other in points
            if other[0] <= error
            and all(a <= (1 + COST_NOISE) * b for a, b in zip(other[1], costs, strict=True))
        ]
        assert mark or len(as_good) > 1
        if not any(other[0] < error or other[1] != costs for other in as_good):
            assert mark


def test_results_that_are_written_do_not_make_the_commit_another(tmp_path: Path) -> None:
    """Else a run that was killed would never resume: it has changed its own file of results."""
    for name in ("docs/result.jsonl", "code.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("one\n")
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], [*identity, "commit", "-q", "-m", "all"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    clean = commit_text(tmp_path)
    (tmp_path / "docs" / "result.jsonl").write_text("two\n")
    assert commit_text(tmp_path) == clean != "unknown"
    (tmp_path / "code.py").write_text("two\n")
    assert commit_text(tmp_path) == f"{clean}-dirty"


MEASURES = ("estimate", "agreement", "move", "surprise", "sure")


def made_up_looks(num_layouts: int, seed: int = 0) -> list[Look]:
    """Return looks whose true error is the geometric mean of two measures, times a factor."""
    rng = np.random.default_rng(seed)
    looks = []
    for layout in range(num_layouts):
        hardness = rng.normal(0, 4)
        for px in LOOKS:
            if px == 256 and not has_wide(layout):
                continue
            for spp in LOOKS[px]:
                figures = dict.fromkeys(FIGURES, 1.0) | {"spp": float(spp), "hits": 0.5}
                for metric in ("log", "linear", "object"):
                    errors = 10 ** ((hardness + rng.normal(0, 1, 5)) / 10) * 100 / spp * 64
                    figures |= {
                        f"{metric}_{name}": float(error)
                        for name, error in zip(MEASURES, errors, strict=True)
                    }
                    true = np.sqrt(errors[1] * errors[3]) * 10 ** (rng.normal(0, 0.5) / 10)
                    figures |= {f"{metric}_true": float(true), f"{metric}_open": 0.1 * float(true)}
                    figures[f"bound_{metric}"] = -10 * float(np.log10(2e-6 * true))
                looks.append(Look(layout=layout, px=px, figures=figures))
    return looks


def test_the_fit_finds_what_matters_in_any_unit_and_keeps_its_risk_on_other_layouts() -> None:
    looks = made_up_looks(240)
    found = fit_metric("log", looks)
    weights = found.weights
    assert min(weights[name] for name in MEASURES) >= 0
    assert min(weights["agreement"], weights["surprise"]) > 0.35
    assert max(weights["estimate"], weights["move"], weights["sure"]) < 0.1
    judging = [look for look in looks if look.use == "judge" and look.px > 64]
    result = judge("log", judging, stated_by("log", found, judging))
    assert result.over_1 <= 2 * ALLOWED["log"]["wide"], "0.5 dB of noise, of which 1.5 % may be out"
    assert 0 < result.caution_db < 2
    assert found.judged["128"].layouts == 120
    # nor do the weights depend on the unit of a measure
    looks = [look for look in made_up_looks(40) if look.px == 64]
    other = [
        dataclasses.replace(
            look, figures={**look.figures, "log_move": 9 * look.figures["log_move"]}
        )
        for look in looks
    ]
    ours, theirs = (fit_weights("log", each).weights for each in (looks, other))
    assert ours == pytest.approx(theirs, abs=1e-6)


def test_the_shift_keeps_the_risk_also_where_sampling_stops_and_a_larger_one_does_not() -> None:
    looks = [look for look in made_up_looks(200) if look.px == 128]
    center = cross_fitted("log", looks)

    def risk(shift_db: float) -> float:
        stated = center + shift_db
        wrong = stated - true_db("log", looks) > 1
        return max(wrong.mean(), wrong[stops("log", looks, stated)].mean())

    shift_db = largest_shift("log", looks, center, 0.015)
    assert risk(shift_db) <= 0.015 < risk(shift_db + 0.05)


def test_sampling_stops_at_the_first_look_that_states_the_target_of_those_that_are_known() -> None:
    looks = [look for look in made_up_looks(1) if look.px == 128]
    stated = np.array([33.0, 35.0, 39.0, 41.0])
    rows = stops("log", looks, stated)
    assert rows == [1, 2, 2, 3, 3, 3], "34 to 44 dB"
    (look, *_) = made_up_looks(1)
    for figures in ({"log_open": 0.5, "log_true": 1.0}, {"log_true": -1.0}):
        assert not filter_known(
            "log", [dataclasses.replace(look, figures={**look.figures, **figures})]
        )
    assert filter_known("log", [look]) == [look]


def _written(path: Path, looks: list[Look], versions: dict[str, str]) -> None:
    trials = {
        look.layout: f"layout {look.layout}, builtin:, plane, plain, {use_of(look.layout)}"
        for look in looks
    }
    points = [f"{px} px, {spp} samples" for px, spps in LOOKS.items() for spp in spps]
    run = begin_run(
        path,
        {
            "experiment": "calibration",
            "machine": {"versions": versions},
            "figures": list(FIGURES),
            "points": [{"name": name} for name in points],
            "trials": list(trials.values()),
        },
    )
    by_point = {
        (look.layout, f"{look.px} px, {look.figures['spp']:.0f} samples"): look for look in looks
    }
    for layout, trial in trials.items():
        for point in points:
            look = by_point.get((layout, point))
            run.add(trial, point, look.figures if look else {})


def test_rows_come_to_a_file_that_pictures_are_stated_by_but_those_of_other_versions_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows, file = tmp_path / "rows.jsonl", tmp_path / "stated_errors.json"
    monkeypatch.setattr(stated_errors, "FILE", file)
    looks = made_up_looks(33)
    _written(rows, looks, versions_of_pictures())
    assert len(read_looks(rows)) == len(looks)
    main([str(rows)])
    statement = load_statement(file)
    assert statement is not None and statement.spp == (32, 288) and statement.widths == (64, 256)
    assert capsys.readouterr().out.count("| log | ") == 3, "one a width"
    rows = tmp_path / "others.jsonl"
    _written(rows, made_up_looks(20), {**versions_of_pictures(), "denoiser": "0"})
    with pytest.raises(TrilightError, match="it has 0 layouts .* expected 8"):
        read_looks(rows)
