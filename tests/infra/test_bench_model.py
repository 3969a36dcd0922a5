"""The benchmark of the network on a small one: every side runs, and the reports are whole."""

import dataclasses
from pathlib import Path

import pytest
import torch

from infra.bench.harness import Comparison, Spread
from infra.bench.model import cases, cases_report, growth
from infra.bench.model.contenders import DEFAULT, EQUAL, PUBLISHED, SIDES, Contenders
from infra.bench.model.training import TRAINING, training_step
from infra.bench.model.workloads import scene_of
from model.costs import Workload, flops
from model.published.config import PublishedConfig
from tests.model.test_published import publishable

CPU = torch.device("cpu")
CONFIG = PublishedConfig(model=publishable("dpt"), texture_patch=8)
FULL = Workload(triangles=300, views=2, resolution=32)
PLANE = Workload(triangles=40, views=2, resolution=32)


@pytest.fixture(scope="module")
def measured() -> Comparison:
    rounds: list[None] = []
    plan = cases.Plan(config=CONFIG, workloads={"full": FULL, "plane-only": PLANE}, repeats=1)
    result = cases.measure(plan, CPU, lambda: rounds.append(None))
    assert len(rounds) == cases.rounds_of(plan, CPU)
    return result


@pytest.mark.slow
def test_the_sides_are_one_network(measured: Comparison) -> None:
    for case in ("full", "plane-only"):
        # float32 rounds sums of size 1 to 1e-7, over a dozen layers
        assert measured.sides[cases.side_name(case, EQUAL)]["difference"].median < 1e-5
        # bfloat16 keeps 8 bits: a network of this depth is off by a percent, a wrong one by all
        error_db = measured.sides[cases.side_name(case, DEFAULT)]["psnr_log_db"].median
        assert 30 < error_db < 99
        for side in SIDES:
            assert measured.sides[cases.side_name(case, side)]["memory_bytes"].median > 0


@pytest.mark.slow
def test_the_published_side_pays_for_textures(measured: Comparison) -> None:
    """It needs its own input at least, of which ours is a thousandth."""
    published, equal = (
        measured.sides[cases.side_name("full", side)]["memory_bytes"].median
        for side in (PUBLISHED, EQUAL)
    )
    assert published > 4 * 13 * 8 * 8 * FULL.triangles
    assert equal < published


@pytest.mark.slow
def test_the_cases_are_told_and_drawn(measured: Comparison, tmp_path: Path) -> None:
    lines = cases_report.rows(measured)
    assert [name for name, _ in lines if not name.startswith(" ")] == [
        "matmul",
        "full",
        "plane-only",
    ]
    assert all("x faster" in line and "memory" in line for name, line in lines if " " in name)
    cases_report.plot(measured, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


@pytest.mark.slow
def test_ratios_are_of_the_right_sides(measured: Comparison) -> None:
    def with_costs(**seconds: float) -> Comparison:
        sides = {}
        for name, figures in measured.sides.items():
            value = seconds[name.split(": ")[-1].replace(" ", "_")]
            fixed = {"core_s": value, "memory_bytes": 10 * value}
            sides[name] = {
                **figures,
                **{
                    key: dataclasses.replace(figures["seconds"], median=number)
                    for key, number in fixed.items()
                },
            }
        return dataclasses.replace(measured, sides=sides)

    changed = with_costs(
        published=12.0, float32=6.0, bfloat16=2.0, matmul_float32=8.0, matmul_bfloat16=2.0
    )
    assert cases_report.ratios(changed, "full") == {
        "equal": 2.0,
        "default": 6.0,
        "more": 3.0,
        "share": 0.75,
        "memory equal": 0.5,
        "memory default": pytest.approx(1 / 6),
    }


def test_growth_is_told_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is measured in the cases above, in a process for each side."""
    monkeypatch.setattr(growth, "peaks_of", lambda side, config, cases, on: [1 << 20] * len(cases))
    plan = growth.Plan(
        config=CONFIG,
        middle=PLANE,
        values={"triangles": (20, 40), "views": (1, 2), "resolution": (32, 64)},
        repeats=1,
    )
    assert len(plan.workloads()) == 4
    rounds: list[None] = []
    result = growth.measure(plan, CPU, lambda: rounds.append(None))
    assert len(rounds) == growth.rounds_of(plan)
    assert len(growth.rows(result)) == 8
    growth.plot(result, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_one_view_is_not_the_other() -> None:
    contenders = Contenders(CONFIG, (EQUAL,), CPU)
    with torch.no_grad():
        first, second = contenders.prepared(EQUAL, PLANE)()
    assert (first - second).abs().max() > 0.01


@pytest.mark.parametrize("triangles", [16, 140, 301])
def test_scenes_have_the_size_that_is_asked_for(triangles: int) -> None:
    scene = scene_of(Workload(triangles=triangles, views=3, resolution=32))
    assert scene.num_triangles == triangles and scene.num_views == 3
    assert scene.material_TM[:, -3:].max() > 0, "a light is among them"
    assert len(scene.c2w_V44.unique(dim=0)) == 3


@pytest.mark.slow
def test_on_a_graphics_card_the_share_of_its_peak_is_told(
    measured: Comparison, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock counts there, and 50 TFLOP/s of a peak of 100 are half."""
    monkeypatch.setattr(cases_report, "peak_tflops", lambda device: 100.0)
    half = Spread(median=50_000.0, low=50_000.0, high=50_000.0)
    sides = {**measured.sides, TRAINING: {"gflop_per_s": half}}
    told = dict(cases_report.rows(dataclasses.replace(measured, sides=sides)))
    assert told[TRAINING] == "50.0 TFLOP/s, 50% of 100"
    assert "of 100" in told["  bfloat16, of the device"]


def test_a_training_step_is_counted() -> None:
    small = Workload(triangles=20, views=1, resolution=32)
    step = training_step(CONFIG.model, CPU, workload=small, scenes=2)
    figures = step()
    assert figures["gflop"] == pytest.approx(6e-9 * sum(flops(CONFIG.model, small).values()))
    assert figures["gflop_per_s"] > 0
