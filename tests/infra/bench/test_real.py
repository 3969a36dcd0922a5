"""Cheap experiments, measured for real and end to end, at an effort of seconds."""

import dataclasses
from pathlib import Path

import pytest

from infra.bench.catalogue import chosen
from infra.bench.curve import Row, rows
from infra.bench.effort import Asked
from infra.bench.experiments import rungs
from infra.bench.run import run
from tests.infra.bench.bench_kit import TINY


@pytest.fixture(autouse=True)
def few_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hundred of the benchmark take minutes to prepare, and two scenes use few of them."""
    monkeypatch.setattr(rungs, "BENCHMARK", "builtin:12")


def measured(name: str, folder: Path) -> dict[str, Row]:
    (one,) = chosen([name])
    store = run(one, dataclasses.replace(TINY, repeats=1), Asked(), folder=folder)
    found = store.newest()
    assert found is not None and store.path.with_suffix(".png").stat().st_size > 5000
    return {row.point.name: row for row in rows(one, found)}


def test_attention_is_exact_to_rounding(tmp_path: Path) -> None:
    found = measured("attention", tmp_path)
    errors = {name: row.values["largest absolute error"] for name, row in found.items()}
    # sums of a hundred numbers of size 1: float32 rounds them to 1e-6, bfloat16 to 1e-2
    assert max(errors["fused"], errors["fused, with a mask"], errors["torch's own products"]) < 1e-5
    assert 1e-4 < errors["fused, bfloat16"] < 0.1


def test_bfloat16_is_not_float32(tmp_path: Path) -> None:
    exact, rounded = measured("precision", tmp_path).values()
    assert exact.values["psnr_log_db, dB"] == 100.0 and exact.point.default
    # 8 bits: a network of this depth is off by a percent, a wrong one by all
    assert 30 < rounded.values["psnr_log_db, dB"] < 99


@pytest.mark.slow("benchmarks")
def test_our_renderer_beside_plain_mitsuba(tmp_path: Path) -> None:
    found = measured("frontier", tmp_path)
    db = {name: row.values["psnr_log_db, dB"] for name, row in found.items()}
    assert db["mitsuba 512"] > db["mitsuba 64"] > 20  # a picture of something else has below 20
    assert found["trilight 46 dB"].values["other side at equal error, times"] > 0


@pytest.mark.slow("benchmarks")
def test_rungs_come_nearer_with_samples_and_with_what_is_traced(tmp_path: Path) -> None:
    found = measured("rungs-64", tmp_path)
    db = {name: row.values["psnr_log_db, dB"] for name, row in found.items()}
    assert db["16 samples, fast"] > db["1 sample, fast"]
    cost = {name: row.values["a further view, core-s"] for name, row in found.items()}
    assert cost["direct light, no network"] < cost["all traced light, no network"]
    # of one row they are milliseconds, which vary by more than loading a tiny scene takes
    firsts = [row.values["a scene's first view, core-s"] for row in found.values()]
    assert sum(firsts) > sum(cost.values())
    assert not found["network builtin:"].intervals and len(found) == 10
