"""Checks that every group of settings makes of its numbers; a complaint names the field."""

import dataclasses
import math
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
    """Check every number and pair of numbers of a settings dataclass.

    Numbers must be finite and from 0, pairs in order as well, and pairs of whole numbers stay so.

    Args:
        settings: the dataclass; other fields are passed over.
        shares: fields that are shares of something, and so at most 1.
        signed: fields that may be below 0.

    Raises:
        TrilightError: the first field that breaks a law.
    """
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if isinstance(value, bool) or not _is_numeric(value):
            continue
        low, high = value if isinstance(value, tuple) else (value, value)
        finite = math.isfinite(low) and math.isfinite(high)
        require(finite, field.name, value, "finite numbers")
        require(low <= high, field.name, value, "the lower number first")
        require(low >= 0 or field.name in signed, field.name, value, "numbers from 0")
        require(high <= 1 or field.name not in shares, field.name, value, "at most 1")
        if field.type in (int, Counts):
            whole = isinstance(low, int) and isinstance(high, int)
            require(whole, field.name, value, "whole numbers")


def _is_numeric(value: object) -> bool:
    if isinstance(value, tuple):
        return len(value) == 2 and all(isinstance(part, int | float) for part in value)
    return isinstance(value, int | float)
