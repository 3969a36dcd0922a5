"""Ranges that several groups of scene settings share, and complaints about laws between fields."""

from typing import Annotated

from storage.errors import TrilightError
from storage.settings.ranges import LowFirst, Within

Range = Annotated[tuple[float, float], LowFirst()]
"""Least and greatest value, both included."""

Counts = Annotated[tuple[int, int], LowFirst()]
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
