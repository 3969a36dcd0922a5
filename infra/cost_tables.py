"""Tables of costs and errors: numbers as text, and the rows that no other row dominates."""

from collections.abc import Sequence

COST_NOISE = 0.03
"""Costs that differ by less than this fraction count as equal: core-seconds vary by that much."""


def number_text(value: float) -> str:
    """Return a number with three digits or a little more, without powers of ten where it can."""
    size = abs(value)
    if value == 0 or size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def on_front(figures: Sequence[tuple[float, Sequence[float]]]) -> list[bool]:
    """Return which of some points no other one dominates.

    One with less error dominates where none of its costs is more than COST_NOISE higher; one with
    the same error where none is higher and one is more than COST_NOISE lower. Some point always
    remains, since a dominating point has less error, or the same error and less cost.

    Args:
        figures: error (smaller is better) and costs above 0 of each point, equally many.
    """
    return [not any(_dominates(other, mine) for other in figures) for mine in figures]


def _dominates(other: tuple[float, Sequence[float]], mine: tuple[float, Sequence[float]]) -> bool:
    costs = list(zip(other[1], mine[1], strict=True))
    if other[0] < mine[0]:
        return all(a <= (1 + COST_NOISE) * b for a, b in costs)
    lower = any((1 + COST_NOISE) * a < b for a, b in costs)
    return other[0] == mine[0] and lower and all(a <= b for a, b in costs)
