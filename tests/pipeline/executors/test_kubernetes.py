"""What falls to a task of an indexed Job, by the variables of Kubernetes."""

from pathlib import Path

import pytest

from pipeline.executors.kubernetes import PLACE, shards_of_place
from pipeline.executors.registry import find_executor
from storage.errors import TrilightError
from storage.number_ranges import number_ranges, numbers_of
from tests.for_each import for_each
from tests.pipeline.making.tiny_scenes_kit import tiny_order

GIVEN = {"TASKS": "0-1,7", "SHARDS_PER_TASK": "4"}


def test_a_place_is_a_task_that_is_missing() -> None:
    shares = [shards_of_place({**GIVEN, PLACE: str(place)}) for place in range(3)]
    assert shares == ["0:4", "4:8", "28:32"]


@for_each(
    ("environment", "message"),
    [
        ({}, "TASKS is not set; expected .* as trilight submit kubernetes makes it"),
        (GIVEN, f"{PLACE} is not set"),
        ({**GIVEN, PLACE: "3"}, f"{PLACE} is 3; expected a place below 3"),
        ({**GIVEN, PLACE: "-1"}, f"{PLACE} is '-1'; expected a number from 0"),
        ({**GIVEN, PLACE: "\N{SUPERSCRIPT TWO}"}, "expected a number from 0"),
        ({**GIVEN, PLACE: "0", "SHARDS_PER_TASK": "0"}, "SHARDS_PER_TASK is '0'; .* from 1"),
        ({**GIVEN, PLACE: "0", "TASKS": "0,,2"}, "TASKS is '0,,2'; expected numbers of tasks"),
        ({**GIVEN, PLACE: "0", "TASKS": "0-999999999"}, "at most 100000"),
        ({**GIVEN, PLACE: "0", "TASKS": ""}, "TASKS is ''"),
    ],
)
def test_what_is_no_array_is_named(environment: dict[str, str], message: str) -> None:
    with pytest.raises(TrilightError, match=f"--runner kubernetes: .*{message}"):
        shards_of_place(environment)


def test_ranges_are_read_as_they_are_written() -> None:
    for numbers in ([], [4], [0, 1, 2, 7], list(range(0, 2000, 2))):
        assert numbers_of(number_ranges(numbers)) == numbers


def test_a_range_of_ones_own_is_refused(tmp_path: Path) -> None:
    order = tiny_order(out=str(tmp_path), scenes=20, shards="0:2")
    with pytest.raises(TrilightError, match="--shards is 0:2; expected none with"):
        find_executor("kubernetes", None, None).make(order, None)
