"""Ranges that several groups of scene settings share, and complaints about laws between fields."""

from typing import Annotated

from storage.errors import TrilightError
from storage.settings.ranges import LowFirst, Within

Range = Annotated[tuple[float, float], LowFirst()]
"""Lowest and highest value, both included."""

Counts = Annotated[tuple[int, int], LowFirst()]
"""Fewest and most, each number between equally likely."""

SIZE = Within(1e-3, 1e3)
"""Range of lengths, in room units."""

OFFSET = Within(0, 1e3)
"""Range of the largest offset in either direction, in room units."""

SHIFT = Within(-1e3, 1e3)
"""Range of translations, in room units."""


def require(law: bool, name: str, value: object, expected: str) -> None:
    """Raise TrilightError unless `law` holds."""
    if not law:
        raise TrilightError(f"scene settings: {name} is {value!r}; expected {expected}.")
