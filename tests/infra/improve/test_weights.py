"""The law of the weights: floor, sum, learnability and cost."""

import dataclasses

import pytest

from infra.improve.weights import Lesson, next_weights
from storage.errors import TrilightError
from tests.for_each import case

BASE = {"a": 1.0, "b": 1.0, "c": 2.0}
LESSON = Lesson(loss_before=0.3, loss=0.2, core_s=2.0)
LESSONS = dict.fromkeys(BASE, LESSON)


def _with(name: str, **changes: float) -> dict[str, Lesson]:
    return {**LESSONS, name: dataclasses.replace(LESSON, **changes)}


def test_shares_sum_to_one_and_keep_the_floor() -> None:
    lessons = {"a": LESSON, "b": dataclasses.replace(LESSON, loss_before=9.0), "c": LESSON}
    for floor in (0.0, 0.3, 1.0):
        weights = next_weights(BASE, lessons, floor)
        assert sum(weights.values()) == pytest.approx(1)
        for name, share in (("a", 0.25), ("b", 0.25), ("c", 0.5)):
            assert weights[name] >= floor * share
    assert next_weights(BASE, lessons, 1.0) == pytest.approx({"a": 0.25, "b": 0.25, "c": 0.5})


def test_where_nothing_is_learnt_scenes_are_drawn_as_the_build_draws_them() -> None:
    """A loss alone, however large, draws nothing: it may be noise."""
    still = {name: Lesson(loss_before=5.0, loss=5.0, core_s=1.0) for name in BASE}
    rising = {**still, "a": Lesson(loss_before=1.0, loss=90.0, core_s=1.0)}
    for lessons in ({}, still, rising, LESSONS):
        assert next_weights(BASE, lessons, 0.3) == pytest.approx({"a": 0.25, "b": 0.25, "c": 0.5})


def test_twice_the_cost_is_half_the_weight_and_twice_the_fall_or_loss_is_twice() -> None:
    dear = next_weights(BASE, _with("a", core_s=4.0), 0.0)
    assert dear["a"] / dear["b"] == pytest.approx(1 / 2)
    learnt = next_weights(BASE, _with("a", loss_before=0.4), 0.0)
    assert learnt["a"] / learnt["b"] == pytest.approx(2)
    lossy = next_weights(BASE, _with("a", loss_before=0.5, loss=0.4), 0.0)
    assert lossy["a"] / lossy["b"] == pytest.approx(2)
    assert lossy["c"] / lossy["b"] == pytest.approx(2), "as the build draws them"


def test_a_stratum_without_a_lesson_is_taken_for_the_mean() -> None:
    known = {"a": LESSON, "c": dataclasses.replace(LESSON, loss_before=0.4)}
    weights = next_weights(BASE, known, 0.0)
    mean = (weights["a"] / 0.25 * 0.25 + weights["c"] / 0.5 * 0.5) / 0.75
    assert weights["b"] / 0.25 == pytest.approx(mean)


def test_a_lesson_that_is_no_number_is_named() -> None:
    for wrong in [{"core_s": 0.0}, {"loss": float("nan")}, {"loss_before": 1e400}]:
        with case(wrong):
            with pytest.raises(TrilightError, match="stratum 'b' has the lesson"):
                next_weights(BASE, _with("b", **wrong), 0.3)
