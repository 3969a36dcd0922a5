"""Strict access to the fields of a JSON object.

Every error names the file, the field, its value and what was expected. Fields that the reader never
asks for are collected as unknown, so that a misspelt option is reported instead of ignored.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

from pipeline.foreign.numbers import Malformed, read_number
from storage.errors import TrilightError
from storage.settings.ranges import Within

_MAX_SHOWN = 120
"""Maximum number of characters of a value in a message."""

_MAX_TEXT = 200
"""Maximum number of characters of a text field."""


class Fields:
    """One JSON object of a file, read field by field."""

    def __init__(self, value: Any, *, file: str, where: str, unknown: list[str]) -> None:
        """Wrap a value of the JSON tree.

        Args:
            value: the parsed value.
            file: name of the file, for messages.
            where: dotted name of this object inside the file; empty for the root.
            unknown: receives the names of fields that are never read (`end`).

        Raises:
            TrilightError: `value` is not a JSON object.
        """
        self._file = file
        self._where = where
        self._unknown = unknown
        if not isinstance(value, dict):
            self._refuse(where or "the file", value, "a JSON object")
        self._values: dict[str, Any] = value
        self._read_keys: set[str] = set()

    def end(self) -> None:
        """Add the names of fields that were not read to `unknown`."""
        unread = [key for key in self._values if key not in self._read_keys]
        self._unknown += [to_text(self._name(key)) for key in unread]

    def keys(self) -> Iterator[str]:
        """Yield the names of all fields, which must be short printable text."""
        for key in self._values:
            if not key or len(key) > _MAX_TEXT or not key.isprintable():
                self._refuse(self._name(key), key, f"a printable name of 1 to {_MAX_TEXT} letters")
            yield key

    def group(self, key: str) -> "Fields":
        """Return a field that is a JSON object."""
        return self._inner(self._get(key), self._name(key))

    def groups(self, key: str, most: int) -> list["Fields"]:
        """Return a field that is a list of JSON objects, with at most `most` entries."""
        rows = self._get(key)
        if not isinstance(rows, list) or not 1 <= len(rows) <= most:
            self._refuse(self._name(key), rows, f"a list of 1 to {most} JSON objects")
        return [self._inner(row, f"{self._name(key)}[{at}]") for at, row in enumerate(rows)]

    def text(self, key: str) -> str:
        """Return a field that is printable text."""
        value = self._get(key)
        if not isinstance(value, str) or len(value) > _MAX_TEXT or not value.isprintable():
            self._refuse(self._name(key), value, f"printable text of up to {_MAX_TEXT} letters")
        return value

    def choice(self, key: str, options: Sequence[str], default: str) -> str:
        """Return a field that is one of `options`, or `default` where it is missing."""
        value = self._get(key, default)
        if value not in options:
            self._refuse(self._name(key), value, f"one of {', '.join(options)}")
        return str(value)

    def flag(self, key: str, default: bool | None = None) -> bool:
        """Return a field that is true or false; it may be missing where there is a default."""
        value = self._get(key, default)
        if not isinstance(value, bool):
            self._refuse(self._name(key), value, "true or false")
        return value

    def integer(self, key: str, low: int, high: int, default: int) -> int:
        """Return a field that is an integer from `low` to `high`."""
        value = self._get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self._refuse(self._name(key), value, f"a whole number from {low} to {high}")
        return value

    def optional_integer(self, key: str, low: int, high: int) -> int | None:
        """Return an integer field, or None where it is missing or null."""
        self._read_keys.add(key)
        return None if self._values.get(key) is None else self.integer(key, low, high, low)

    def number(self, key: str, low: float, high: float, default: float | None = None) -> float:
        """Return a field that is a finite number from `low` to `high`."""
        return self._number(self._name(key), self._get(key, default), low, high)

    def vector(self, key: str, low: float, high: float) -> tuple[float, float, float]:
        """Return a field that is a list of three finite numbers from `low` to `high`."""
        values = self._get(key)
        name = self._name(key)
        if not isinstance(values, list) or len(values) != 3:
            self._refuse(name, values, "a list of three numbers")
        x, y, z = (self._number(f"{name}[{at}]", v, low, high) for at, v in enumerate(values))
        return x, y, z

    def _inner(self, value: Any, where: str) -> "Fields":
        return Fields(value, file=self._file, where=where, unknown=self._unknown)

    def _number(self, name: str, value: Any, low: float, high: float) -> float:
        try:
            return read_number(value, to_text(name), Within(low, high))
        except Malformed as error:
            raise TrilightError(f"{self._file}: {error}.") from error

    def _get(self, key: str, default: Any = None) -> Any:
        """Return a value, or its default; a field without a default must exist."""
        self._read_keys.add(key)
        if key in self._values:
            return self._values[key]
        if default is None:
            raise TrilightError(f"{self._file}: {self._name(key)} is missing; add it.")
        return default

    def _name(self, key: str) -> str:
        return f"{self._where}.{key}" if self._where else key

    def _refuse(self, name: str, value: Any, expected: str) -> NoReturn:
        raise TrilightError(
            f"{self._file}: {to_text(name)} is {to_text(value)}; expected {expected}."
        )


def to_text(value: Any) -> str:
    """Return a value as short text for a message, on one line without control characters."""
    text = value if isinstance(value, str) and value.isprintable() else repr(value)
    return text if len(text) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN - 3]}..."
