"""The mark of execution is found wherever it stands among a field's notes, and nowhere else."""

from typing import Annotated

import pytest

from storage.errors import TrilightError
from storage.settings.described import checked, described
from storage.settings.execution import EXECUTION
from storage.settings.ranges import Within

Count = Annotated[int, Within(1, 9)]


@checked("group")
class Group:
    """One of each."""

    plain: int
    """Meaning."""
    ranged: Count = 1
    """Meaning, with a range."""
    marked: Annotated[int, Within(1, 9), EXECUTION] = 1
    """Marked after its range."""
    alias: Annotated[Count, EXECUTION] = 1
    """Marked around an alias."""
    switch: Annotated[bool, EXECUTION] = False
    """Marked alone."""


def test_what_is_marked_is_described_so() -> None:
    marked = {field.name for field in described(Group) if field.is_execution}
    assert marked == {"marked", "alias", "switch"}


def test_a_mark_changes_no_range() -> None:
    by_name = {field.name: field for field in described(Group)}
    assert by_name["marked"].expected == by_name["ranged"].expected
    assert by_name["switch"].expected == "true or false"
    with pytest.raises(TrilightError, match="marked is 10; expected a whole number from 1 to 9"):
        Group(plain=0, marked=10)
    with pytest.raises(TrilightError, match="switch is 1; expected true or false"):
        Group(plain=0, switch=1)  # type: ignore[arg-type]
