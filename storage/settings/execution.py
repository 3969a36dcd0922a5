"""Marks of settings that change how something is executed, and not its meaning.

    scenes_per_pass: Annotated[int, Within(1, 65_536, unit="scenes"), EXECUTION] = 16

Execution is what would change nothing if numbers had no rounding, so it is free to differ whenever
work goes on. All that is not marked is meaning.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin


@dataclass(frozen=True)
class Execution:
    """The mark itself, a note of a field's type beside its range."""


EXECUTION = Execution()
"""Marks a field."""


def is_execution(hint: Any) -> bool:
    """Return whether a field's type, with its notes, is marked."""
    return any(isinstance(note, Execution) for note in _notes(hint))


def _notes(hint: Any) -> Iterator[Any]:
    while get_origin(hint) is Annotated:
        hint, *notes = get_args(hint)
        yield from notes
