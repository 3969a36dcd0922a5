"""Notes of fields, above all ranges: declared once, at the field; checked and printed from there.

    fov_deg: Annotated[Range, Within(1, 170, unit="degrees")] = (30.0, 60.0)
    scenes_per_pass: Annotated[int, Within(1, 65_536, unit="scenes"), EXECUTION] = 16

`storage.settings.described` checks them, and tests/extremes goes to both ends of each and one step
outside. Laws between fields are none of this: they stay in `__post_init__`, or in `Scene.check`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np


class Law(ABC):
    """Note at a field whose values obey a law beyond their type."""

    @abstractmethod
    def require(self, value: Any) -> Any:
        """Return a lawful value; another is a ValueError, or an error of pydantic's."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Let pydantic check the law after the type."""
        from pydantic_core import core_schema  # readers of scenes do without pydantic

        return core_schema.no_info_after_validator_function(self.require, handler(source))


@dataclass(frozen=True)
class Within(Law):
    """Lowest and highest value; both are admitted unless that end is open."""

    low: float
    high: float
    low_open: bool = False
    """True: `low` itself is refused."""
    high_open: bool = False
    """True: `high` itself is refused."""
    unit: str = ""
    """Plural noun that is counted or measured; empty for pure numbers."""

    def holds(self, value: Any) -> Any:
        """Return whether a number is in the range, or of each number of an array; NaN is not."""
        above = value > self.low if self.low_open else value >= self.low
        below = value < self.high if self.high_open else value <= self.high
        return above & below

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        """Let forms show the range, at the number or at the entries of a list."""
        return self._add_bounds(handler(schema))

    def __str__(self) -> str:
        """Return the range as the end of a sentence, such as `from 1 to 170 degrees`."""
        low = shown_number(self.low)
        high = shown_number(self.high)
        start = f"above {low}" if self.low_open else f"from {low}"
        if self.high_open:
            end = f" and below {high}" if self.low_open else f" to below {high}"
        else:
            end = f", up to {high}" if self.low_open else f" to {high}"
        return start + end + (f" {self.unit}" if self.unit else "")

    def require(self, value: Any) -> Any:
        """Return a number, or a tuple of numbers, in the range."""
        from pydantic_core import PydanticCustomError

        numbers = value if isinstance(value, tuple) else (value,)
        if not all(number is None or self.holds(number) for number in numbers):
            raise PydanticCustomError(
                "outside_range", "expected numbers {range}", {"range": str(self)}
            )
        return value

    def _add_bounds(self, form: dict[str, Any]) -> dict[str, Any]:
        """Return a JSON schema with the ends of the range, but for those that are no limit."""
        if "anyOf" in form:
            return form | {"anyOf": [self._add_bounds(option) for option in form["anyOf"]]}
        if form.get("type") == "array":  # pairs as lists too: forms know no tuples
            rest = {name: part for name, part in form.items() if name != "prefixItems"}
            return rest | {"items": self._add_bounds(form.get("items") or form["prefixItems"][0])}
        if form.get("type") not in ("integer", "number"):
            return form
        bounds: dict[str, Any] = {}
        if abs(self.low) <= _EXACT:
            bounds["exclusiveMinimum" if self.low_open else "minimum"] = self.low
        if abs(self.high) <= _EXACT:
            bounds["exclusiveMaximum" if self.high_open else "maximum"] = self.high
        return form | bounds


_EXACT = 2**53
"""Largest integer of JavaScript; forms would show larger ones rounded."""


@dataclass(frozen=True)
class LowFirst(Law):
    """Law of a pair: the first number is at most the second."""

    def require(self, value: Any) -> Any:
        if value[0] > value[1]:
            raise ValueError("expected the lower number first")
        return value


EXECUTION = "execution"
"""Marks a field that changes how something is executed, and not its meaning.

Execution is what would change nothing if numbers had no rounding, so it is free to differ whenever
work goes on. All that is not marked is meaning.
"""

Share = Annotated[float, Within(0, 1)]
"""A part of a whole, or a probability."""

Seed = Annotated[int, Within(0, 2**256 - 1)]
"""What randomness is drawn from (storage.seeds hashes it, so any integer would do)."""

FLOAT32_MAX = float(np.finfo(np.float32).max)
"""The largest finite float32."""


def shown_number(number: float) -> str:
    """Return a number for a person: 2^64 - 1 instead of twenty digits."""
    if isinstance(number, int):
        power = (number + 1).bit_length() - 1
        return f"2^{power} - 1" if power > 30 and number + 1 == 1 << power else str(number)
    return f"{number:.6g}"
