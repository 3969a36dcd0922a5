"""Settings as words of the command line, so that a command can be repeated elsewhere."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from storage.settings.described import described, option_of


def option_words(settings: Any, *, leave_out: tuple[str, ...] = ()) -> list[str]:
    """Return the options of a command that state settings, but for those at their default.

    Args:
        settings: an instance of a class of settings.
        leave_out: fields that are not stated.
    """
    kind: Any = type(settings)
    return [
        word
        for field in described(kind)
        if field.name not in leave_out and getattr(settings, field.name) != field.default
        for word in _words(option_of(field.name), getattr(settings, field.name))
    ]


def _words(option: str, value: Any) -> Iterator[str]:
    if isinstance(value, bool):
        yield option
    elif isinstance(value, Mapping):
        for name, new in value.items():
            yield from (option, f"{name}={_json_or_word(new)}")
    elif isinstance(value, tuple):
        for entry in value:
            yield from (option, str(entry))
    else:
        yield from (option, str(value))


def _json_or_word(value: Any) -> str:
    """Return a value as the command line reads it: a word that is no JSON stands for itself."""
    if isinstance(value, str):
        try:
            json.loads(value)
        except json.JSONDecodeError:
            return value
    return json.dumps(value)
