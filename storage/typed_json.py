"""Typed reading of JSON that Trilight wrote: a wrong type or number is one sentence.

    note = read_json(data, ShardNote, "train-000003.tar.json")

The type is a dataclass, or made of dataclasses; ranges and spellings are notes at its fields
(`Within`, `Spelled`, `FINITE`). Numbers of 5,000 digits, depth and unknown fields are refused too.
"""

import contextlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from storage.conventions import require_readable
from storage.errors import TrilightError
from storage.settings.ranges import Law

T = TypeVar("T")


@dataclass(frozen=True)
class Spelled:
    """Spelling of a whole text."""

    pattern: str
    """Regular expression that matches all of it."""
    expected: str

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Let pydantic check the spelling with the type."""
        from pydantic_core import core_schema

        return core_schema.str_schema(pattern=rf"(?s)\A(?:{self.pattern})\z", strict=True)


@dataclass(frozen=True)
class Finite(Law):
    """Law of any JSON value: no NaN and no infinity in it."""

    expected: str = "JSON values with finite numbers"

    def require(self, value: Any) -> Any:
        json.dumps(value, allow_nan=False)
        return value


@dataclass(frozen=True)
class Converted:
    """Note at a field that holds what a function makes of its JSON."""

    convert: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Let pydantic take anything, and call the function."""
        from pydantic_core import core_schema

        return core_schema.no_info_plain_validator_function(self.convert)


DROPPED = Converted(lambda value: None)
FINITE = Finite()
Sha256 = Annotated[str, Spelled("[0-9a-f]{64}", "64 hexadecimal digits")]
ShortText = Annotated[str, Spelled(".{0,1000}", "a text of at most 1000 characters")]


def read_json(data: bytes | str, kind: type[T], source: str) -> T:
    """Return the value of a JSON text, checked strictly.

    Args:
        data: the text; bytes are UTF-8.
        kind: its type.
        source: begins the complaint, such as the path of the file.

    Raises:
        TrilightError: other JSON than the type says; names source, field, value and what was
            expected.
    """
    from storage.settings.described import parse_strictly  # pydantic takes time to import

    value = parse_strictly(data, kind, source)
    if value is None:
        raise TrilightError(f"{source}: null; expected the file as it was written.")
    return value


def read_versioned(data: bytes | str, kind: type[T], source: str, versions: Sequence[int]) -> T:
    """Return the value of a JSON text that states its `schema_version`; otherwise as `read_json`.

    A text of another version need not be of this type: then its version says more.

    Args:
        data, kind, source: as `read_json`.
        versions: those that are read.
    """
    try:
        value = read_json(data, kind, source)
    except TrilightError:
        version = versions[0]  # unless the text states one, whatever else it is
        with contextlib.suppress(ValueError, LookupError, TypeError, RecursionError):
            version = json.loads(data)["schema_version"]
        require_readable(version, source, versions)
        raise
    require_readable(vars(value)["schema_version"], source, versions)
    return value


def read_json_lines(data: bytes, kind: type[T], source: str, *, torn_end: bool = False) -> list[T]:
    """Return the values of lines of JSON; raises as `read_json`, naming the line.

    Args:
        data: the lines.
        kind: type of each.
        source: the file, for messages.
        torn_end: leave out a last line that a kill has cut, which no line break ends.
    """
    lines = data[: data.rfind(b"\n") + 1 if torn_end else None].splitlines()
    return [read_json(line, kind, f"{source}:{row}") for row, line in enumerate(lines, start=1)]
