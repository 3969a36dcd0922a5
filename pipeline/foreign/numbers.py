"""Single numbers of untrusted files: finite and in range, or refused by the name of their field.

Arrays are checked by their readers.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from storage.errors import TrilightError
from storage.settings.ranges import FLOAT32_MAX, Within

FINITE = Within(-FLOAT32_MAX, FLOAT32_MAX)
_COUNTS = Within(0, 2**53)


class Malformed(TrilightError):
    """A file breaks a rule of its format; the message is ours, and the caller names the file."""


def read_number(stated: Any, field: str, within: Within = FINITE) -> float:
    """Return a number; raises Malformed, by the name of its field, for any other value."""
    is_number = isinstance(stated, int | float | np.number) and not isinstance(stated, bool)
    if not is_number or not within.holds(stated):
        is_plain = is_number or isinstance(stated, str | int | list | dict | None)
        value_text = f"{stated!r:.60}" if is_plain else f"a {type(stated).__name__}"
        range_text = "that is finite" if within is FINITE else str(within)
        raise Malformed(f"{field} is {value_text}; expected a number {range_text}")
    return float(stated)


def read_numbers(stated: Any, count: int, field: str) -> tuple[float, ...]:
    """Return `count` numbers; raises Malformed for another count, or as `read_number`."""
    rows = list(stated) if hasattr(stated, "__len__") else []
    if len(rows) != count:
        raise Malformed(f"{field} has {len(rows)} values; expected {count} numbers")
    names = [field] if count == 1 else [f"{field}[{at}]" for at in range(count)]
    return tuple(read_number(row, name) for name, row in zip(names, rows, strict=True))


def parse_number(word: str, field: str) -> float:
    """Return the number that a word spells; raises Malformed as `read_number`."""
    try:
        stated: Any = float(word)
    except ValueError:
        stated = word
    return read_number(stated, field)


def read_count(row: Mapping[str, Any], name: str, default: int | None = None) -> int:
    """Return a field as a count, 0 to 2^53; raises Malformed as `read_number`."""
    return int(read_number(row.get(name, default), name, _COUNTS))
