"""A search for the smallest triangle budget whose decimation still passes."""

from collections.abc import Callable
from typing import TypeVar

from storage.errors import Rejected

Result = TypeVar("Result")

_STEP = 2 ** (1 / 8)
"""Ratio of neighboring budgets: the result has at most 9 % more triangles than the smallest
possible one, and one more trial would halve that."""

_FEWEST = 4
"""Faces of the smallest closed surface."""


def smallest_passing(attempt: Callable[[int], Result], largest: int) -> Result:
    """Return the result of `attempt` at the smallest budget up to `largest` that it accepts.

    Bisection over falling budgets: six or seven attempts. The error of a decimation is almost, not
    exactly, monotonic in its budget, so the search may miss a smaller budget that passes; the
    returned result always passed.

    Raises:
        Rejected: `largest` itself does not pass.
    """
    budgets = _falling_budgets(largest)
    best = attempt(budgets[0])
    passed = 0
    failed = len(budgets)
    while failed - passed > 1:
        middle = (passed + failed) // 2
        try:
            best = attempt(budgets[middle])
            passed = middle
        except Rejected:
            failed = middle
    return best


def _falling_budgets(largest: int) -> list[int]:
    """Return falling budgets from `largest` down to the fewest faces."""
    budgets = [largest]
    budget = float(largest)
    while (budget := budget / _STEP) >= _FEWEST:
        if round(budget) < budgets[-1]:
            budgets.append(round(budget))
    return budgets
