"""The trainings that seek rates: what differs between them, and which rate is called the best."""

import dataclasses
import json
from pathlib import Path

import pytest

from infra.bench.effort import CAREFUL, QUICK
from infra.bench.experiments.learning_rates import (
    EXPERIMENTS,
    EXTENTS,
    ONE_RATE,
    OPTIMISERS,
    RATES,
    SCHEDULES,
    best_rates,
    extent_of,
    rate_name,
)
from infra.bench.sides.rated_trainings import Amount, Rated, network_of, run_of
from infra.bench.store import Store
from model.costs import Workload, costs
from storage.errors import TrilightError

SEEN = dataclasses.replace(
    EXTENTS["quick"], steps=4, widths=(64, 128), seeds=2, compared_widths=(64, 128), held_out=2
)
FEW = Amount(steps=200, scenes_per_step=2, precision="float32")


def write_run(folder: Path, best: dict[tuple[str, int], float]) -> Store:
    """Write errors whose least, over two seeds, is at the best rates."""
    store = Store(folder / "learning-rates-quick.jsonl")
    run = store.begin({"points": [], "turns": []})
    for (optimiser, width), least in best.items():
        for rate in RATES[optimiser]:  # type: ignore[index]
            for seed in (0, 1):
                # the least of one seed is elsewhere, and of the other further down
                error = 0.04 + 0.01 * (rate != least) + (0.002 if seed else -0.002)
                name = rate_name(optimiser, ONE_RATE, rate)
                store.add(run, f"width {width}, seed {seed}", name, {"log_l1": error})
    return store


def test_the_best_rate_is_that_of_least_error_at_its_width(tmp_path: Path) -> None:
    best = {("AdamW", 64): 1e-3, ("AdamW", 128): 5e-4, ("Muon", 64): 1e-3, ("Muon", 128): 2e-3}
    store = write_run(tmp_path, best)
    assert best_rates(SEEN, tmp_path) == best
    # a later run that has not tried all of them is passed by
    later = store.begin({"points": [], "turns": ["others"]})
    store.add(later, "width 64, seed 0", rate_name("AdamW", ONE_RATE, 4e-3), {"log_l1": 0.001})
    assert json.loads(store.path.read_text().splitlines()[-1])["figures"] == {"log_l1": 0.001}
    assert best_rates(SEEN, tmp_path) == best


def test_without_rates_nothing_is_compared(tmp_path: Path) -> None:
    with pytest.raises(TrilightError, match="run that first, with the same --data"):
        best_rates(SEEN, tmp_path)


def test_trainings_differ_in_what_they_are_named_for() -> None:
    made = {
        name: run_of(Rated(learning_rate=1e-3, **what), FEW, width=128, seed=3)  # type: ignore[arg-type]
        for name, what in {**OPTIMISERS, **SCHEDULES}.items()
    }
    assert {run.muon_rate for name, run in made.items() if "Muon" in name} == {3.0}
    assert {run.muon_rate for name, run in made.items() if "AdamW" in name} == {0.0}
    for name, run in made.items():
        half = "half" in name
        assert (run.num_steps, run.warmup_steps) == ((100, 10) if half else (200, 20))
        assert run.schedule == ("cosine" if "cosine" in name else "wsd")
        assert (run.seed, run.model, run.base_widths.width) == (3, network_of(128), 0)
    by_width = Rated(optimiser="AdamW", learning_rate=1e-3, by_width=True)
    one = run_of(by_width, FEW, width=128, seed=0)
    assert one.base_widths.width == 64 and one.model.head_width == 64


def test_the_careful_form_is_what_was_asked_for() -> None:
    """1 M to 20 M parameters, 2000 steps at least, and others judge than those that chose."""
    extent = extent_of(CAREFUL)
    assert extent.steps >= 2000 and extent.seeds >= 2 and extent.compared_seeds >= 4
    chosen, judged = (
        {turn.split("seed ")[1] for turn in one.turns(CAREFUL)} for one in EXPERIMENTS[:2]
    )
    assert chosen.isdisjoint(judged)
    work = Workload(triangles=300, views=2, resolution=32)
    millions = [
        sum(costs(network_of(width), work).parameters.values()) / 1e6 for width in extent.widths
    ]
    assert min(millions) < 1 and max(millions) > 20
    assert extent_of(QUICK) == EXTENTS["quick"] and {one.by_point for one in EXPERIMENTS} == {
        True,
        False,
    }
