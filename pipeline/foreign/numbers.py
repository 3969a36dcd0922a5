"""Numbers that stand alone in strangers' files: finite, in range, or refused by their fields.

Arrays of numbers are checked where they are read.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from storage.errors import TrilightError
from storage.settings.ranges import FLOAT32_MAX, Within

FINITE = Within(-FLOAT32_MAX, FLOAT32_MAX)
_COUNTS = Within(0, 2**53)


class Malformed(TrilightError):
    """A law of its format that a file breaks, in words of ours; the caller names the file."""


def read_number(stated: Any, field: str, within: Within = FINITE) -> float:
    """Return a number; raises Malformed, by the name of its field, for any other value."""
    is_number = isinstance(stated, int | float | np.number) and not isinstance(stated, bool)
    if not is_number or not within.holds(stated):
        is_plain = is_number or isinstance(stated, str | int | list | dict | None)
        shown = f"{stated!r:.60}" if is_plain else f"a {type(stated).__name__}"
        range_text = "that is finite" if within is FINITE else str(within)
        raise Malformed(f"{field} is {shown}; expected a number {range_text}")
    return float(stated)


def read_numbers(stated: Any, count: int, field: str) -> tuple[float, ...]:
    """Return so many numbers; raises Malformed as `read_number`, or where there are not so many."""
    rows = list(stated) if hasattr(stated, "__len__") else []
    if len(rows) != count:
        raise Malformed(f"{field} has {len(rows)} values; expected {count} numbers")
    names = [field] if count == 1 else [f"{field}[{at}]" for at in range(count)]
    return tuple(read_number(row, name) for name, row in zip(names, rows, strict=True))


def parse_number(word: str, field: str) -> float:
    """Return the number that a word of a text is; raises Malformed as `read_number`."""
    try:
        stated: Any = float(word)
    except ValueError:
        stated = word
    return read_number(stated, field)


def read_count(row: Mapping[str, Any], name: str, default: int | None = None) -> int:
    """Return a field that counts something; raises Malformed as `read_number`."""
    return int(read_number(row.get(name, default), name, _COUNTS))
