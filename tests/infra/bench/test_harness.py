"""Laws of the harness: turns, spread, front, a store that survives a kill, table and figure."""

import dataclasses
import json
import math
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from infra.bench import run as running
from infra.bench.curve import COST_NOISE, PricedLevel, at_error, on_front, rows, spread
from infra.bench.effort import Asked
from infra.bench.experiment import Column, Experiment, Point, points_of
from infra.bench.machine import machine, revision
from infra.bench.plot import plot
from infra.bench.run import newest_run, run, run_share
from infra.bench.shares import share_of
from infra.bench.store import Run, Store
from infra.bench.table import markdown, printed, shown
from storage.errors import TrilightError
from storage.intervals import mean_interval
from tests.for_each import case
from tests.infra.bench.bench_kit import FIGURES, TINY, calls, experiment


@pytest.fixture(autouse=True)
def same_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """The revision of a working tree may change while tests run; no figure is drawn."""
    calls.clear()
    here = machine()
    monkeypatch.setattr(running, "machine", lambda device: here)
    monkeypatch.setattr(running, "plot", lambda *_: None)


@pytest.fixture
def figures(same_machine: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the figure of a run, as a user sees it."""
    monkeypatch.setattr(running, "plot", plot)


def measured(folder: Path, one: Experiment, data: str | None = None) -> Run:
    store = run(one, TINY, Asked(data=data), folder=folder)
    found = store.newest()
    assert found is not None
    return found


def test_points_take_turns_and_the_first_round_does_not_count(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    run(
        experiment("a", "b", warm_up=True),
        TINY,
        Asked(),
        folder=tmp_path,
        turn_done=lambda *numbers: done.append(numbers),
    )
    in_turns = [(turn, point) for turn in ("a", "a", "b") for point in FIGURES]
    assert calls == in_turns  # the first three were not counted
    assert done == [(1, 2), (2, 2)]
    found = newest_run(tmp_path, "made-up")
    assert found is not None and found[0].whole_turns() == ["a", "b"]


def test_columns_and_spread_are_over_the_turns(tmp_path: Path) -> None:
    cheap, default, waste = rows(experiment(), measured(tmp_path, experiment("a", "b", "c")))
    assert cheap.values["core-seconds"] == pytest.approx((1 + 1 + 1.5) / 3)
    assert cheap.values["a second"] == pytest.approx(3 / 3.5)
    assert cheap.values["psnr_log_db, dB"] == 30.0
    assert cheap.cost_spread is not None
    assert (cheap.cost_spread.low, cheap.cost_spread.median, cheap.cost_spread.high) == (1, 1, 1.5)
    assert default.cost_ratio == 1 and waste.cost_ratio == pytest.approx(9.5 / 6.5)
    assert [row.on_front for row in (cheap, default, waste)] == [True, True, False]


def test_a_turn_that_fails_for_one_point_counts_for_none(tmp_path: Path) -> None:
    found = measured(tmp_path, experiment("a", "bad", "c"))
    assert found.whole_turns() == ["a", "c"]
    assert found.left_out == {"bad": "no_scene: it has no light"}
    with pytest.raises(TrilightError, match="no turn could be measured: no_scene: it has no light"):
        measured(tmp_path / "none", experiment("bad"))


def test_results_name_a_dataset_and_not_where_it_lies(tmp_path: Path) -> None:
    named = [
        measured(tmp_path, experiment("a"), f"/srv/someone/{folder}/set").plan["asked"]["data"]
        for folder in ("here", "there")
    ]
    assert all(re.fullmatch(r"set \([0-9a-f]{8}\)", name) for name in named)
    assert len(set(named)) == 2 and all(
        "someone" not in path.read_text() for path in tmp_path.glob("*.jsonl")
    )


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path) -> None:
    one = experiment("a", "killed", "c")
    with pytest.raises(KeyboardInterrupt):
        measured(tmp_path, one)
    assert newest_run(tmp_path, "made-up") is None  # not ended
    before = list(calls)
    calls.clear()
    with pytest.raises(KeyboardInterrupt):  # the same plan, which is killed again
        measured(tmp_path, one)
    assert calls[0] == ("killed", "cheap") and ("a", "cheap") in before
    calls.clear()
    measured(tmp_path, one, data="another plan")  # figures of another plan are not taken
    assert calls[0] == ("a", "cheap")


def test_where_points_stand_alone_only_what_a_turn_lacks_is_measured_again(tmp_path: Path) -> None:
    one = dataclasses.replace(experiment("a", "killed", "c"), by_point=True)
    with pytest.raises(KeyboardInterrupt):
        measured(tmp_path, one)
    assert calls[-1] == ("killed", "waste")
    calls.clear()
    with pytest.raises(KeyboardInterrupt):
        measured(tmp_path, one)
    assert calls == [("killed", "waste")]


def test_shares_together_are_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every row once, by calls on several machines; a share goes on, and what is lost is found."""
    one = dataclasses.replace(experiment("a", "b", "c"), by_point=True)
    for number in (1, 2, 3, 4):
        here = {**machine(), "card": "card", "processor": f"chip {number}"}
        monkeypatch.setattr(running, "machine", lambda device, here=here: here)
        share = share_of(f"{number}/4")
        store = run_share(one, TINY, Asked(), share, folder=tmp_path)
        rows_now = store.path.read_bytes()
        assert run_share(one, TINY, Asked(), share, folder=tmp_path).path.read_bytes() == rows_now
    assert sorted(calls) == sorted((t, p.name) for t in "abc" for p in one.points(TINY))
    share_of("4/4").path(tmp_path / "made-up-quick.jsonl").unlink()
    calls.clear()
    found = measured(tmp_path, one)
    assert len(calls) == 2 and found.whole_turns() == ["a", "b", "c"]
    assert "3 rows are of card, chip 1" in found.notes
    monkeypatch.setattr(running, "machine", lambda device: {**here, "revision": "another"})
    calls.clear()
    measured(tmp_path, one)
    assert len(calls) == 9, "rows of another revision are not taken"


def test_turns_that_are_compared_within_are_shared_whole(tmp_path: Path) -> None:
    one = experiment("a", "b", "c")
    run_share(one, TINY, Asked(), share_of("2/2"), folder=tmp_path)
    assert calls == [("b", point.name) for point in one.points(TINY)]
    run_share(one, TINY, Asked(), share_of("1/2"), folder=tmp_path)
    calls.clear()
    assert measured(tmp_path, one).whole_turns() == ["a", "b", "c"] and not calls


def test_a_share_that_is_none_is_refused() -> None:
    for text in ["0/4", "5/4", "4", "a/b", "1/0"]:
        with case(text):
            with pytest.raises(TrilightError, match="expected K/N"):
                share_of(text)


@settings(max_examples=30, deadline=None)  # each writes a dozen lines to the disk
@given(cut=st.integers(0, 900))
def test_whatever_is_left_of_a_file_can_be_gone_on_with(
    cut: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A kill may cut the file anywhere; what was whole stays, and the run ends the same."""
    folder = tmp_path_factory.mktemp("store")
    store = Store(folder / "x.jsonl")
    plan = {"points": ["p", "q"], "turns": ["a", "b"]}
    wanted = {"a": {"p": {"x": 1.0}, "q": {"x": 2.0}}, "b": {"p": {"x": 3.0}, "q": {"x": 4.0}}}
    _go_on(store, plan, wanted)
    whole = store.path.read_bytes()
    store.path.write_bytes(whole[: min(cut, len(whole) - 1)])
    assert _go_on(store, plan, wanted).turns == wanted
    assert [json.loads(line) for line in store.path.read_text().splitlines()]


def _go_on(store: Store, plan: dict, wanted: dict) -> Run:
    current = store.begin(plan)
    for turn in current.missing_turns():
        for point, figures in wanted[turn].items():
            store.add(current, turn, point, figures)
    store.end(current, 1.0, ["a note"])
    found = store.newest()
    assert found is not None and found.notes == ["a note"] and not found.missing_turns()
    return found


def test_careful_results_are_believed_before_quick_ones(tmp_path: Path) -> None:
    measured(tmp_path, experiment("a"))
    found = newest_run(tmp_path, "made-up")
    assert found is not None and found[1].path.name == "made-up-quick.jsonl"
    (tmp_path / "made-up.jsonl").write_bytes((tmp_path / "made-up-quick.jsonl").read_bytes())
    found = newest_run(tmp_path, "made-up")
    assert found is not None and found[1].path.name == "made-up.jsonl"


@pytest.mark.usefixtures("figures")
def test_the_table_has_every_point_and_the_figure_is_a_picture(tmp_path: Path) -> None:
    one = experiment("a", "c")
    found = measured(tmp_path, one)
    lines = list(markdown(one, found))
    assert lines[0] == "| setting | core-seconds | ratio | psnr_log_db, dB | a second | front |"
    assert lines[3] == "| **default** | 2.25 | 1.00 x | 40.0 | 0.44 | yes |"
    assert len(lines) == 2 + len(FIGURES)
    assert list(printed(one, found))[1][1] == "1.25 (1.00 to 1.50)"
    with Image.open(tmp_path / "made-up-quick.png") as picture:
        assert picture.width > 300 and len(set(picture.convert("L").tobytes())) > 20


def paired(*turns: str) -> Experiment:
    """Return the experiment beside its rival, with both costs in the figure."""
    one = experiment(*turns)
    return dataclasses.replace(
        one,
        columns=(
            Column(name="again", figure="core_s"),
            Column(name="more than the rival, dB", figure="db", over="pair"),
        ),
        also_cost=("again",),
        kind=lambda name: "cheap ones" if name == "cheap" else "others",
        rival=lambda asked: "default",
    )


def test_pairs_are_taken_turn_by_turn_with_their_interval(tmp_path: Path) -> None:
    one = paired("a", "b", "c")
    found = measured(tmp_path, one)
    for turn, db in (("a", 28.0), ("b", 30.0), ("c", 35.0)):
        found.turns[turn]["cheap"] = {"core_s": 1.0, "db": db}
    cheap, default, waste = rows(one, found)
    name = one.columns[1].name
    assert cheap.values[name] == pytest.approx((28 + 30 + 35) / 3 - 40)
    assert cheap.intervals[name] == mean_interval([-12.0, -10.0, -5.0], ["a", "b", "c"])
    assert name not in default.values and not default.intervals, "the rival is not its own rival"
    assert waste.intervals[name] == (-5.0, -5.0)
    cells = [line.split(" | ")[5] for line in [*markdown(one, found)][2:]]
    assert cells == ["-9.0 (-12.0 to -5.0)", "", "-5.0 (-5.0 to -5.0)"]


def test_pairs_are_of_the_turns_that_have_the_figure(tmp_path: Path) -> None:
    one = dataclasses.replace(
        paired("a", "b", "c"), columns=(Column(name="of some", figure="part", over="pair"),)
    )
    one = dataclasses.replace(one, also_cost=(), kind=None)
    found = measured(tmp_path, one)
    for turn, part in (("a", 3.0), ("c", 5.0)):
        for point, more in (("cheap", part), ("default", 1.0)):
            found.turns[turn][point] = {**found.turns[turn][point], "part": more}
    cheap, *_ = rows(one, found)
    assert cheap.values["of some"] == 3.0
    assert cheap.intervals["of some"] == mean_interval([2.0, 4.0], ["a", "c"])


@pytest.mark.usefixtures("figures")
def test_a_figure_of_kinds_shows_every_cost(tmp_path: Path) -> None:
    measured(tmp_path, paired("a", "c"))
    with Image.open(tmp_path / "made-up-quick.png") as picture:
        red = np.asarray(picture.convert("RGB")).astype(int)
        assert picture.width > 800 and (red[..., 0] - red[..., 2] > 100).sum() > 50


@pytest.mark.usefixtures("figures")
def test_a_figure_of_lines_has_a_panel_for_every_column_that_was_measured(tmp_path: Path) -> None:
    def shape(*figures: str) -> tuple[int, int]:
        one = dataclasses.replace(
            experiment("a", "c"),
            columns=tuple(Column(name=f"of {figure}", figure=figure) for figure in figures),
            line_of=lambda point: (
                "others" if point.name == "waste" else "line",
                1.0 + len(point.name),
            ),
        )
        measured(tmp_path, one)
        with Image.open(tmp_path / "made-up-quick.png") as picture:
            colours = set(picture.convert("RGB").get_flattened_data())
            assert {(31, 119, 180), (255, 127, 14)} <= colours  # both lines
            return picture.size

    (one, high), (two, same) = shape("db", "absent"), shape("db", "core_s")
    assert high == same and 1.6 * one < two < 2 * one


def test_points_of_what_is_asked_for_come_first_and_names_are_of_one_thing(tmp_path: Path) -> None:
    asked = Asked(checkpoint=("runs/x/model.safetensors", "builtin:", "y"))
    assert asked.network == "runs/x/model.safetensors"
    assert asked.network_names == ("x", "builtin:", "y"), "and no path of this machine"
    one = dataclasses.replace(
        experiment("a"),
        asked_points=lambda asked: [Point(name=name) for name in asked.network_names],
    )
    assert [point.name for point in points_of(one, TINY, asked)] == [
        *asked.network_names,
        *FIGURES,
    ]
    twice = Asked(checkpoint=("a/x", "b/x"))
    with pytest.raises(TrilightError, match="'x' is there twice"):
        run(one, TINY, twice, folder=tmp_path)


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


LEVELS = [PricedLevel(spp=1 << k, core_s=2.0**k, db=30 + 3.0 * k) for k in range(5)]


def test_equal_error_lies_between_the_levels() -> None:
    for level in LEVELS:
        assert at_error(LEVELS, level.db) == (level, True)
    found, has_it = at_error(LEVELS, 34.5)
    assert has_it and found.spp == pytest.approx(2**1.5) and 2 < found.core_s < 4
    assert at_error(LEVELS, 50.0) == (LEVELS[-1], False)
    assert at_error(LEVELS, 20.0) == (LEVELS[0], False)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1))
def test_a_spread_holds_its_values(values: list[float]) -> None:
    found = spread(values)
    assert found.low == min(values) and found.high == max(values)
    assert found.low <= found.median <= found.high


TOLD: list[tuple[float, str]] = [
    (0, "0"),
    (1234.5, "1234"),
    (12.34, "12.3"),
    (1.234, "1.23"),
    (0.0123, "0.012"),
]


def test_numbers_are_told_with_three_digits() -> None:
    for value, text in TOLD:
        with case(text):
            assert shown(value) == text and not math.isnan(float(text))


def test_the_machine_is_told() -> None:
    here = machine()
    assert {"processor", "cores", "system", "versions", "revision"} == set(here)
    assert here["cores"] >= 1


def test_results_that_are_written_do_not_make_the_revision_another(tmp_path: Path) -> None:
    """Else a run that was killed would never go on: it has changed its own file of results."""
    for name in ("docs/result.jsonl", "code.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("one\n")
    identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
    for words in (["init", "-q"], ["add", "."], [*identity, "commit", "-q", "-m", "all"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    clean = revision(tmp_path)
    (tmp_path / "docs" / "result.jsonl").write_text("two\n")
    assert revision(tmp_path) == clean != "unknown"
    (tmp_path / "code.py").write_text("two\n")
    assert revision(tmp_path) == f"{clean}-dirty"
