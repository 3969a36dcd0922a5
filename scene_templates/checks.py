"""Checks that every group of settings makes of its numbers; a complaint names the field."""

import dataclasses
from typing import Any

from storage.errors import TrilightError

Range = tuple[float, float]
"""Least and greatest value, both included."""

Counts = tuple[int, int]
"""Fewest and most, each number between equally likely."""


def require(law: bool, name: str, value: object, expected: str) -> None:
    """Raise TrilightError unless `law` holds."""
    if not law:
        raise TrilightError(f"scene settings: {name} is {value!r}; expected {expected}.")


def check_numbers(
    settings: Any, *, shares: tuple[str, ...] = (), signed: tuple[str, ...] = ()
) -> None:
    """Check every number and pair of numbers of a settings dataclass by the type of its field.

    Numbers must be of their kind, from 0, and below 1e100; pairs in order as well.

    Args:
        settings: the dataclass; fields of other types are passed over.
        shares: fields that are shares of something, and so at most 1.
        signed: fields that may be below 0.

    Raises:
        TrilightError: the first field that breaks a law.
    """
    for field in dataclasses.fields(settings):
        if field.type not in _EXPECTED:
            continue
        value = getattr(settings, field.name)
        require(_fits(value, field.type), field.name, value, _EXPECTED[field.type])
        low, high = value if isinstance(value, tuple) else (value, value)
        finite = -_LARGEST < low < _LARGEST and -_LARGEST < high < _LARGEST
        require(finite, field.name, value, "finite numbers below 1e100")
        require(low <= high, field.name, value, "the lower number first")
        require(low >= 0 or field.name in signed, field.name, value, "numbers from 0")
        require(high <= 1 or field.name not in shares, field.name, value, "at most 1")


_LARGEST = 1e100
"""Beyond any use; its square is still a float."""

_EXPECTED: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    Range: "two numbers",
    Counts: "two whole numbers",
}


def _fits(value: Any, kind: Any) -> bool:
    if kind in (Range, Counts):
        single = float if kind == Range else int
        pair = isinstance(value, tuple) and len(value) == 2
        return pair and all(_fits(part, single) for part in value)
    allowed = int if kind is int else (int, float)
    return isinstance(value, allowed) and not isinstance(value, bool)
