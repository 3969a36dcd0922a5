"""Checks that every group of settings makes of its numbers; a complaint names the field."""

from typing import Any

from storage.errors import TrilightError
from storage.ranges import Within, check_ranges, declared_ranges

Range = tuple[float, float]
"""Least and greatest value, both included."""

Counts = tuple[int, int]
"""Fewest and most, each number between equally likely."""

SIZE = Within(1e-3, 1e3)
"""Of what has a size or a distance, in nominal rooms: a thousandth, to a thousand of them."""

OFFSET = Within(0, 1e3)
"""Of the most by which something is moved, either way."""

SHIFT = Within(-1e3, 1e3)
"""Of where something is moved to."""


def require(law: bool, name: str, value: object, expected: str) -> None:
    """Raise TrilightError unless `law` holds."""
    if not law:
        raise TrilightError(f"scene settings: {name} is {value!r}; expected {expected}.")


def check_numbers(settings: Any) -> None:
    """Check the numbers of a settings dataclass: each in its range, and pairs in order.

    Raises:
        TrilightError: the first field that breaks a law.
    """
    check_ranges(settings, "scene settings: ")
    kind: Any = type(settings)
    for field in declared_ranges(kind):
        if field.shape == "pair":
            low, high = value = getattr(settings, field.name)
            require(low <= high, field.name, value, "the lower number first")
