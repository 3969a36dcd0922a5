"""Predictions: the arithmetic of means and intervals, and what is said before it is too late."""

import dataclasses

import pytest

from infra.planning import MeasuredScenes, predict
from pipeline.flows.order import DatasetOrder
from pipeline.flows.pieces import MOST_TASKS


def _measured(core_s: tuple[float, ...], num_bytes: int = 150_000) -> MeasuredScenes:
    return MeasuredScenes(core_s=core_s, num_bytes=(num_bytes,) * len(core_s), num_views=4)


def test_equal_scenes_add_up_exactly() -> None:
    """The first scene, which compiles, is left out; nothing varies, so intervals are points."""
    order = DatasetOrder(build="pretrain-256", scenes=2560)
    found = predict(_measured((99.0, 36.0, 36.0)), order, cores=16, usd_per_core_hour=0.5)
    assert (found.num_scenes, found.num_shards) == (2560, 10)
    assert found.core_hours.value == pytest.approx(25.6)  # floating point only
    assert (found.core_hours.low, found.core_hours.high) == pytest.approx((25.6, 25.6))
    assert found.hours.value == pytest.approx(1.6)
    assert found.usd.value == pytest.approx(12.8)
    assert found.gigabytes.value == pytest.approx(0.384)
    assert found.num_tasks <= MOST_TASKS
    assert found.notes == ()


def test_an_interval_covers_the_mean_as_often_as_it_says() -> None:
    """Of 200 sets of 40 lognormal scenes; 90 % stated, and a bootstrap of 40 falls a little short:
    at least 80 % here leaves room for that and for the binomial spread of 2 %."""
    import numpy as np

    rng = np.random.default_rng(0)
    order = DatasetOrder(build="smoke", scenes=3600)
    truth = float(np.exp(0.5 * 0.6**2))
    hits = 0
    for _ in range(200):
        core_s = tuple(float(value) for value in rng.lognormal(0.0, 0.6, 41))
        interval = predict(_measured(core_s), order, cores=1, usd_per_core_hour=1).core_hours
        assert interval.low <= interval.value <= interval.high
        hits += interval.low <= truth <= interval.high
    assert hits >= 160


def test_two_million_scenes_come_with_warnings() -> None:
    order = DatasetOrder(build="pretrain-256", scenes=2_000_000)
    measured = _measured((400.0, 400.0))
    found = predict(measured, order, cores=4096, usd_per_core_hour=0.04)
    assert found.num_tasks == MOST_TASKS
    assert any("manifest.json" in note for note in found.notes)
    assert any("flow runs" in note for note in found.notes)
    fewer = predict(measured, dataclasses.replace(order, scenes=500), cores=1, usd_per_core_hour=1)
    assert not any("manifest.json" in note for note in fewer.notes)
