"""Fronts, tables, the page and its choices; and the knobs that need no renderer."""

import dataclasses
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from infra.bench import harness
from infra.bench.harness import Options
from infra.bench.marked_block import read_block
from infra.bench.renders.equal_error import Priced, at_error
from infra.bench.trade import page, run
from infra.bench.trade.choices import CHOICES
from infra.bench.trade.curves import Curve, Knob, Point, judged, on_front
from infra.bench.trade.figures import shown, shown_error
from infra.bench.trade.knobs import KNOBS, knob_named
from infra.bench.trade.saved import saved_curves
from infra.bench.trade.workshop import QUICK, Workshop
from storage.errors import TrilightError
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.infra.trade_kit import TINY
from tests.scenes_by_hand import tiny_sample

OPTIONS = Options(quick=True, objects=("builtin:",), allowed_licences=())
_figure = st.integers(1, 5).map(float)


# of figures closer than the noise, and farther
_near = st.sampled_from([1.0, 1.02, 1.04, 1.06, 2.0])


@given(st.lists(st.tuples(_figure, st.tuples(_figure, _figure)), min_size=1, max_size=12))
def test_the_front_is_what_nobody_dominates(
    points: list[tuple[float, tuple[float, float]]],
) -> None:
    """Whole figures differ by more than the noise: the front is the one of the books."""
    front = on_front(points)
    for (error, costs), mark in zip(points, front, strict=True):
        mine = (error, *costs)
        better = [
            other
            for other in ((error, *costs) for error, costs in points)
            if other != mine and all(a <= b for a, b in zip(other, mine, strict=True))
        ]
        assert mark == (not better)


@given(st.lists(st.tuples(_figure, st.tuples(_near, _near)), min_size=1, max_size=12))
def test_noise_decides_nothing(points: list[tuple[float, tuple[float, float]]]) -> None:
    front = on_front(points)
    least = min(error for error, _ in points)
    # of those with the least error somebody always stays
    assert any(mark for (error, _), mark in zip(points, front, strict=True) if error == least)
    for (error, (first, second)), mark in zip(points, front, strict=True):
        nearer = [costs for other, costs in points if other < error]
        if any(max(a / first, b / second) <= 1.03 for a, b in nearer):
            assert not mark


def test_a_cost_is_worse_only_beyond_the_noise() -> None:
    assert on_front([(2.0, [1.0]), (1.0, [1.02])]) == [False, True]
    assert on_front([(2.0, [1.0]), (1.0, [1.04])]) == [True, True]
    assert on_front([(1.0, [1.0]), (1.0, [1.02]), (1.0, [1.04])]) == [True, True, False]


def _knob(**changes: object) -> Knob:
    return dataclasses.replace(knob_named("guides"), **changes)  # type: ignore[arg-type]


def _curve(*points: tuple[str, float, float | None]) -> Curve:
    made = [
        Point(setting=name, cost=cost, error=error, default=name == "b", further={"kB": 10 / cost})
        for name, cost, error in points
    ]
    return Curve(points=tuple(made), measured_on="points by hand")


def test_points_are_judged_beside_the_default() -> None:
    curve = _curve(("a", 1, 30), ("b", 2, 40), ("c", 3, 35), ("d", 4, None), ("e", 5, 41))
    found = judged(_knob(), curve)
    assert [one.cost_ratio for one in found] == [0.5, 1, 1.5, 2, 2.5]
    assert [one.on_front for one in found] == [True, True, False, None, True]
    lower = judged(_knob(better="lower"), curve)
    assert [one.on_front for one in lower] == [True, False, False, None, False]
    # c is cheaper in the second cost than all before it
    both = judged(_knob(also_cost=("kB",)), curve)
    assert [one.on_front for one in both] == [True, True, True, None, True]
    # what is no setting is neither judged nor dominates
    shown_beside = judged(_knob(yardstick="e"), curve)
    assert [one.on_front for one in shown_beside] == [True, True, False, None, None]
    with pytest.raises(TrilightError, match="knob guides: 0 of 1 settings are the default"):
        judged(_knob(), _curve(("a", 1, 30)))


def test_equal_error_lies_between_levels() -> None:
    levels = [Priced(spp=4, core_s=1.4, db=20), Priced(spp=16, core_s=2.6, db=30)]
    middle = at_error(levels, 25)
    # half of two doublings; each sample costs a tenth of a core-second
    assert (middle.bound, middle.spp, middle.core_s) == ("exactly", 8, pytest.approx(1.8))
    assert at_error(levels, 30).core_s == pytest.approx(2.6)
    assert at_error(levels, 20).bound == "exactly"
    assert (at_error(levels, 19).bound, at_error(levels, 19).spp) == ("at most", 4)
    assert (at_error(levels, 31).bound, at_error(levels, 31).spp) == ("more than", 16)


def test_figures_are_shown_with_three_digits() -> None:
    assert [shown(x) for x in (0, 0.0123, 0.998, 1, 12.34, 123.4, 12345.6)] == [
        "0", "0.012", "1.00", "1.00", "12.3", "123", "12346"
    ]  # fmt: skip
    assert shown_error(knob_named("depth"), 46.04) == "46.0"
    assert shown_error(knob_named("size"), None) == "n/a"


def test_knobs_are_told_apart_and_say_what_they_are() -> None:
    for field in ("name", "title"):
        values = [getattr(knob, field) for knob in KNOBS]
        assert len(set(values)) == len(values)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["trade", "--knob", "speed"], "--knob 'speed': unknown; expected one of samples, "),
        (["trade", "--part", "cost"], "it has no parts"),
        (["shards", "--write-docs"], "expected it only with trade"),
    ],
)
def test_mistakes_are_told_before_anything_is_measured(words: list[str], said: str) -> None:
    assert said in trilight(["bench", *words]).mistake


def _write(
    folder: Path, name: str, date: str, knob: str, cost: float, *more: tuple[str, float, float]
) -> None:
    curve = dataclasses.asdict(_curve(("b", cost, 40), *more))
    record = {"curves": {knob: curve}, "date": date, "machine": {"processor": "abacus"}}
    (folder / f"{name}-{date}.json").write_text(json.dumps(record))


def test_the_newest_and_most_careful_result_counts(tmp_path: Path) -> None:
    def cost(knob: str) -> float:
        return saved_curves(tmp_path)[knob].curve.points[0].cost

    _write(tmp_path, "trade", "2026-01-01", "guides", 1)
    _write(tmp_path, "trade", "2026-01-01", "depth", 1)
    _write(tmp_path, "trade-quick", "2026-01-02", "guides", 2)
    assert (cost("guides"), cost("depth")) == (2, 1)
    _write(tmp_path, "trade-guides-quick", "2026-01-02", "guides", 3)
    assert cost("guides") == 3
    _write(tmp_path, "trade", "2026-01-02", "guides", 4)
    assert cost("guides") == 4


def test_the_page_says_what_the_results_say(tmp_path: Path) -> None:
    _write(tmp_path, "trade-quick", "2026-01-02", "guides", 2)
    apart = ("one picture of each light", 9.0, 45.0)
    _write(tmp_path, "trade-lights-quick", "2026-01-02", "lights", 2, apart)
    text = page.block(tmp_path)
    assert text.startswith("## Every knob")
    assert "| **b** | 2.00 | 1.00 x | 40.0 | 5.00 | yes |" in text
    assert "Settings: `build.renders.aux_spp`.\n" in text
    assert "Also a cost: kB.\n" in text
    assert "![Error against cost: Samples of the denoiser's guide pictures](bench/trade/" in text
    assert "Not measured yet (`trilight bench trade --knob depth`)" in text
    for knob in KNOBS:
        assert f"\n### {knob.title}\n" in text and knob.because in text


def test_what_was_only_measured_quickly_says_so(tmp_path: Path) -> None:
    _write(tmp_path, "trade-quick", "2026-01-02", "guides", 2)
    assert "**Not run: careful**, for all knobs. Their figures" in page.block(tmp_path)
    _write(tmp_path, "trade-roulette", "2026-01-02", "roulette", 2)
    assert "**Not run: careful**, for `guides`. Their figures" in page.block(tmp_path)
    _write(tmp_path, "trade", "2026-01-02", "guides", 2)
    assert "Not run: careful" not in page.block(tmp_path)


def test_the_documentation_is_what_the_results_say() -> None:
    """`trilight bench trade --write-docs` was run after the last benchmark."""
    written = read_block(ROOT / "docs" / "tradeoffs.md", page.MARK)
    assert written == page.block(ROOT / "docs" / "bench")


def test_no_choice_is_refuted_by_the_results_beside_it() -> None:
    """What is advised is on its front, or its text says why it is advised all the same."""
    saved = saved_curves(ROOT / "docs" / "bench")
    for choice in CHOICES:
        knob = knob_named(choice.knob)
        marks = {one.point.setting: one for one in judged(knob, saved[knob.name].curve)}
        assert marks[choice.setting].on_front or choice.despite, choice.need


def test_a_choice_off_the_front_says_so(tmp_path: Path) -> None:
    points = [("faithful", 1, 1), ("uniform", 9, 2)]
    made = [Point(setting=n, cost=c, error=e, default=c == 1) for n, c, e in points]
    curve = dataclasses.asdict(Curve(points=tuple(made), measured_on="two methods"))
    record = {"curves": {"profile": curve}, "date": "2026-01-01", "machine": {"processor": "it"}}
    (tmp_path / "trade-2026-01-01.json").write_text(json.dumps(record))
    (line,) = [line for line in page.block(tmp_path).splitlines() if "even size" in line]
    assert "(not on the front: `faithful` is nearer and cheaper" in line


def test_what_is_missing_is_left_out_with_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    options = dataclasses.replace(OPTIONS, knobs=("engines",))
    rounds: list[None] = []
    result = run.run(options, lambda: rounds.append(None))
    assert len(rounds) == run.num_rounds(options) == 1
    why = "left out: torch is not installed; run `make setup-all`"
    assert run.rows(result) == [("engines", why)]


@pytest.mark.parametrize("name", ["precision", "attention", "size"])
def test_knobs_of_the_network(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(harness, "RESULTS", tmp_path)  # without a table of small trainings
    monkeypatch.setattr("model.config.SIZES", {"smoke": knob_config()})
    curve = knob_named(name).measure(Workshop(TINY, OPTIONS))
    assert sum(one.point.default for one in judged(knob_named(name), curve)) == 1
    assert all(point.cost > 0 for point in curve.points)
    errors = {point.setting: point.error for point in curve.points}
    if name == "precision":
        # 8 bits of bfloat16 over a few layers: a percent; another network would have below 30
        assert errors["float32"] == 100 and 40 < (errors["bfloat16"] or 0) < 99
    if name == "attention":
        # float32 rounds to 6e-8, bfloat16 to 4e-3, of numbers of size 1
        assert (errors["fused"] or 1) < 1e-5 < (errors["fused, bfloat16"] or 0) < 0.1
    if name == "size":
        assert set(errors.values()) == {None}
        assert all(set(point.further) == {"M parameters"} for point in curve.points)


def knob_config():  # type: ignore[no-untyped-def]
    from model.config import smoke

    return smoke


def test_errors_of_sizes_come_from_the_table(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from infra.bench.trade.network_knobs import trained_scores

    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    rows = [
        {"plan": plan, "change": change, "scenes": scenes, "size": "small",
         "num_steps": 400, "scores": {"log_l1": score, "psnr_log_db_median": 1000 * score}}
        for plan, change, scenes, score in (
            ("cpu", "ours", 960, 0.02), ("cpu", "ours", 960, 0.04), ("cpu", "ours", 60, 0.9),
            ("cpu", "ema", 960, 0.9), ("gpu", "ours", 960, 0.9),
        )
    ]  # fmt: skip
    (tmp_path / "training_table.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    (found,) = trained_scores().items()
    assert found[0] == "table, small" and found[1].steps == 400
    assert (found[1].log_l1, found[1].psnr_log_db) == pytest.approx((0.03, 30))


def test_the_codec_knob_on_samples_by_hand() -> None:
    shop = Workshop(TINY, OPTIONS)
    shop.__dict__["samples"] = [tiny_sample("0", 32, seed=0)]
    knob = knob_named("codec")
    found = {one.point.setting: one for one in judged(knob, knob.measure(shop))}
    assert found["profile compact"].point.default
    assert found["raw half floats"].cost_ratio > found["profile lossless"].cost_ratio
    # nothing is nearer to the picture than its half floats
    exact = found["raw half floats"].point.error
    assert exact is not None
    assert all((one.point.error or 0) <= exact + 1e-9 for one in found.values())


def test_a_result_is_told() -> None:
    curves = {"guides": _curve(("a", 1, 30), ("b", 2, 40)), "depth": _curve(("b", 1, None))}
    result = run.Trade(name="trade", curves=curves, skipped={"engines": "why"}, seconds={})
    lines = run.rows(result)
    assert ("  b", "  1.00 x      40.0  front  default") in lines
    assert ("engines", "left out: why") in lines
    assert json.loads(result.as_json_line())["curves"]["guides"]["points"][0]["cost"] == 1


def test_quick_is_less() -> None:
    assert QUICK.scenes < 12 and QUICK.max_spp % 128 == 0
