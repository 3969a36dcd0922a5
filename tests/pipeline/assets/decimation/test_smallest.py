"""The search for the fewest triangles: near the best for any law of errors, and never a failure."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.assets.decimation.smallest import smallest_passing
from storage.errors import Rejected
from tests.for_each import for_each


def counted(passes: Callable[[int], bool]) -> tuple[Callable[[int], int], list[int]]:
    """Return an attempt that returns its budget where that passes, and the budgets it was given."""
    tried: list[int] = []

    def attempt(budget: int) -> int:
        tried.append(budget)
        if not passes(budget):
            raise Rejected("error_over_bound", "too coarse")
        return budget

    return attempt, tried


@given(largest=st.integers(4, 1_000_000), share=st.floats(0, 1))
def test_a_monotone_error_is_met_within_nine_percent(largest: int, share: float) -> None:
    fewest = max(4, round(largest * share))
    attempt, tried = counted(lambda budget: budget >= fewest)
    found = smallest_passing(attempt, largest)
    # A rung is 2^(1/8) = 1.0905 times the next, and each is rounded to a whole number.
    assert fewest <= found <= 1.091 * fewest + 1
    # 144 rungs from a million to 4 take eight halvings, after the largest itself.
    assert len(tried) <= 9
    assert len(tried) == len(set(tried))


@given(largest=st.integers(4, 5000), passing=st.sets(st.integers(4, 5000)))
def test_whatever_comes_back_has_passed(largest: int, passing: set[int]) -> None:
    attempt, tried = counted(lambda budget: budget == largest or budget in passing)
    found = smallest_passing(attempt, largest)
    assert found == largest or found in passing
    assert 4 <= min(tried)
    assert max(tried) == largest == tried[0]


@given(largest=st.integers(1, 5000))
def test_nothing_is_searched_where_the_largest_fails(largest: int) -> None:
    attempt, tried = counted(lambda budget: False)
    with pytest.raises(Rejected, match="error_over_bound"):
        smallest_passing(attempt, largest)
    assert tried == [largest]


def test_other_errors_are_not_taken_for_failures() -> None:
    def attempt(budget: int) -> int:
        if budget < 1000:
            raise MemoryError
        return budget

    with pytest.raises(MemoryError):
        smallest_passing(attempt, 1000)


@for_each("largest", [1, 2, 3, 4, 5])
def test_the_smallest_budgets(largest: int) -> None:
    attempt, _ = counted(lambda budget: True)
    assert smallest_passing(attempt, largest) == min(largest, 4)
