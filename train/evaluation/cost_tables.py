"""Tables of costs and errors: numbers as text, and the Pareto front of rows."""

from collections.abc import Sequence

COST_NOISE = 0.03
"""Relative difference below which costs count as equal: CPU seconds vary by that much."""


def number_text(value: float) -> str:
    """Return a number with two or three significant digits, mostly without powers of ten."""
    size = abs(value)
    if value == 0 or size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def on_front(figures: Sequence[tuple[float, Sequence[float]]]) -> list[bool]:
    """Return for each point whether it is on the Pareto front: no other point dominates it.

    A point with less error dominates if none of its costs is more than COST_NOISE higher; one with
    the same error, if none of its costs is higher and one is more than COST_NOISE lower. The front
    is never empty, since a dominating point has less error, or the same error and less cost.

    Args:
        figures: error (smaller is better) and costs above 0 of each point, equally many costs.
    """
    return [not any(_dominates(other, mine) for other in figures) for mine in figures]


def _dominates(other: tuple[float, Sequence[float]], mine: tuple[float, Sequence[float]]) -> bool:
    costs = list(zip(other[1], mine[1], strict=True))
    if other[0] < mine[0]:
        return all(a <= (1 + COST_NOISE) * b for a, b in costs)
    lower = any((1 + COST_NOISE) * a < b for a, b in costs)
    return other[0] == mine[0] and lower and all(a <= b for a, b in costs)
