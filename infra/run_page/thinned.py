"""Long curves as few points: what a screen can show, and nothing that stood out lost."""

from collections.abc import Sequence
from dataclasses import dataclass

MOST_POINTS = 240
"""Points of a curve; a chart is hardly wider in pixels."""


@dataclass(frozen=True)
class Point:
    """Neighbouring values of a curve as one."""

    step: int
    """The last step among them."""
    mean: float
    low: float
    high: float


def thinned(points: Sequence[tuple[int, float]], most: int = MOST_POINTS) -> list[Point]:
    """Return at most `most` points, each of equally many neighbours; the last may have fewer."""
    size = -(-len(points) // most)
    found = []
    for start in range(0, len(points), size or 1):
        part = points[start : start + size]
        values = [value for _, value in part]
        mean = sum(values) / len(values)
        found.append(Point(part[-1][0], mean, min(values), max(values)))
    return found
