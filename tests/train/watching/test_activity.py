"""Each moment belongs to one part, and none is lost."""

import time

import pytest

from train.watching.activity import PARTS, Activity


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
    assert activity.taken() == {
        **dict.fromkeys(PARTS, 0.0),
        "other": 1,
        "data": 10,
        "validation": 4,
    }
    now_s += 16
    assert activity.taken()["data"] == 16, "what goes on counts up to now, and once"


def test_a_part_ends_with_an_error() -> None:
    activity = Activity()
    activity.begin("data")
    with pytest.raises(ValueError, match="x"), activity.during("saving"):
        raise ValueError("x")
    assert activity.now.part == "data"
