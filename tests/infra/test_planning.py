"""Predictions: the arithmetic of means and intervals, and what is said before it is too late."""

import dataclasses
from pathlib import Path

import pytest

from infra.planning import MeasuredScenes, measure_scenes, predict
from pipeline.making.dataset_order import DatasetOrder
from pipeline.making.machine import cores_owned
from pipeline.making.pipeline import make_dataset
from pipeline.making.tasks import MOST_TASKS
from storage.dataset.dataset import open_dataset
from storage.dataset.shard import scan_members
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering


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
    assert found.manifest_mb < 2  # it lists 7,813 shards, however many views they hold
    assert any("flow runs" in note for note in found.notes)
    fewer = predict(measured, dataclasses.replace(order, scenes=500), cores=1, usd_per_core_hour=1)
    assert fewer.notes == ()


class _Clock:
    """Stands still while nobody works."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


def test_what_is_measured_are_the_first_scenes_of_the_dataset_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten scenes reach the third shard, which is for validation. The clock moves on by 1000 s for
    the first scene, which a prediction leaves out, and by its number for each other one."""
    clock = _Clock()
    monkeypatch.setattr("pipeline.making.pipeline.time", clock)

    def work(scene: int) -> None:
        clock.now += scene or 1000

    scenes = without_rendering(monkeypatch, work)
    order = tiny_order(out=str(tmp_path / "set"), scenes=24)
    measured = measure_scenes(order, 10, tmp_path / "measured", lambda: None)
    assert not (tmp_path / "set").exists()
    cores = cores_owned()
    assert measured.core_s == tuple(cores * seconds for seconds in (1000, *range(1, 10)))
    sampled = list(scenes)
    scenes.clear()
    make_dataset(order, Undocumented())
    assert sampled == scenes[:10]
    by_key: dict[str, int] = {}
    for shard in open_dataset(str(tmp_path / "set")).manifest.shards:
        with (tmp_path / "set" / shard.name).open("rb") as stream:
            for member in scan_members(stream, shard.name):
                size = 512 + -(-member.num_bytes // 512) * 512
                by_key[member.key] = by_key.get(member.key, 0) + size
    expected = [size for _, size in sorted(by_key.items())]
    assert measured.num_bytes == tuple(expected[:10])
    found = predict(measured, order, cores=1, usd_per_core_hour=1)
    assert found.core_hours.value == pytest.approx(24 * cores * 5 / 3600)  # floating point only
