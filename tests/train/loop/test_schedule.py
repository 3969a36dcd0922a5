"""Laws of the learning rate: one rise, one fall, a constant part that knows nothing of the end."""

import math

import pytest

from storage.settings.described import from_record, settings_record
from tests.for_each import for_each
from tests.train.kit import tiny_run
from train.loop.schedule import decay_begins, learning_rate
from train.runs import RUNS, named_run
from train.settings import TrainSettings


def rates(settings: TrainSettings) -> list[float]:
    return [learning_rate(step, settings) for step in range(settings.num_steps)]


def test_a_cosine_rises_to_its_peak_and_falls_to_its_end_once() -> None:
    settings = tiny_run(num_steps=100, warmup_steps=10, final_rate_share=0.1)
    found = rates(settings)
    assert 0 < found[0] < found[9] < settings.learning_rate
    assert found[10] == settings.learning_rate
    assert found[99] == pytest.approx(0.1 * settings.learning_rate)
    assert found[:11] == sorted(set(found[:11]))
    assert found[10:] == sorted(set(found[10:]), reverse=True)
    assert learning_rate(500, settings) == found[99], "no restart after the end"
    assert decay_begins(settings) is None


def test_a_wsd_rate_rises_stays_and_falls_at_the_end() -> None:
    settings = tiny_run(schedule="wsd", num_steps=100, warmup_steps=10, final_rate_share=0.1)
    found, peak = rates(settings), settings.learning_rate
    assert decay_begins(settings) == 80
    assert found[:10] == [peak * (step + 1) / 11 for step in range(10)]
    assert found[10:81] == [peak] * 71
    for step in range(80, 100):
        fallen = 0.1 + 0.9 * (1 - math.sqrt((step - 80) / 19))
        assert found[step] == pytest.approx(fallen * peak)
    assert found[99] == pytest.approx(0.1 * peak)
    assert learning_rate(500, settings) == found[99], "no restart after the end"


@for_each("share", [0.0, 0.1, 0.2, 0.5])
def test_a_longer_wsd_run_has_the_same_rates_until_the_decay(share: float) -> None:
    short = tiny_run(schedule="wsd", num_steps=60, warmup_steps=7, decay_share=share)
    begins = decay_begins(short)
    for steps in (61, 100, 1000):
        longer = tiny_run(schedule="wsd", num_steps=steps, warmup_steps=7, decay_share=share)
        assert rates(longer)[: begins or 60] == rates(short)[: begins or 60]
    assert begins == (None if share == 0 else 60 - round(60 * share))


def test_the_decay_waits_for_the_warm_up() -> None:
    whole = tiny_run(schedule="wsd", num_steps=60, warmup_steps=50, decay_share=1.0)
    assert decay_begins(whole) == 50
    assert rates(whole)[50] == whole.learning_rate > rates(whole)[51]
    last = tiny_run(schedule="wsd", num_steps=3, warmup_steps=2, decay_share=0.01)
    assert decay_begins(last) == 3 and rates(last)[2] == last.learning_rate


def test_old_records_are_cosines() -> None:
    record = settings_record(named_run("smoke"))
    assert record["schedule"] == "wsd"
    for later in ("schedule", "decay_share"):
        del record[later]
    assert from_record(TrainSettings, record).schedule == "cosine"


def test_who_has_which() -> None:
    """The paper's are cosines, and what made the networks that come along; ours can go on."""
    cosines = {name for name in RUNS if named_run(name).schedule == "cosine"}
    assert {name for name in RUNS if name.startswith("paper-")} <= cosines
    assert {"builtin", "hits", "hits-tokens"} <= cosines
    assert {"smoke", "pretrain", "finetune", "hits-256"}.isdisjoint(cosines)
