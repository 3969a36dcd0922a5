"""Each moment belongs to one part, and none is lost; and who is slow by parts of its own."""

import time

import pytest

from train.watching.activity import PARTS, Activity
from train.watching.ranks import OWN_PARTS, own_seconds, slowest


def test_the_parts_add_up_to_the_time_that_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    activity = Activity()
    now_s += 1
    activity.begin("data")
    now_s += 2
    with activity.during("validation"):
        now_s += 4
        assert activity.now.part == "validation"
    now_s += 8
    # sums of whole numbers below 2^53 are exact
    taken = {"other": 1, "data": 10, "validation": 4}
    assert activity.taken() == dict.fromkeys(PARTS, 0.0) | taken
    now_s += 16
    assert activity.taken()["data"] == 16, "what goes on counts up to now, and once"


def test_a_part_ends_with_an_error() -> None:
    activity = Activity()
    activity.begin("data")
    with pytest.raises(ValueError, match="x"), activity.during("saving"):
        raise ValueError("x")
    assert activity.now.part == "data"


def test_a_process_stands_out_of_the_others_or_none_does() -> None:
    assert slowest([0.1, 0.1, 0.5, 0.12]) == 2
    assert slowest([0.5, 0.1]) == 0
    assert slowest([1.0, 1.2, 1.1]) is None, "less than half more is no news"
    assert slowest([0.001, 0.01]) is None, "milliseconds are no news"
    assert slowest([1.0]) is None


def test_waiting_for_others_is_not_own_work() -> None:
    assert set(PARTS) - set(OWN_PARTS) == {"exchange", "validation", "saving"}
    assert own_seconds({**dict.fromkeys(PARTS, 0.0), "data": 3.0, "exchange": 9.0}, 2) == 1.5
