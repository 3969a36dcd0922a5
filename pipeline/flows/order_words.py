"""Orders as the command line says them, so that a command can be repeated."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from pipeline.flows.order import DatasetOrder
from storage.safe_url import safe_url
from storage.settings import described, option_of

_ELSEWHERE = ("build", "out", "shards", "workers")
"""Which part of the dataset this machine makes, where, and with how many processes."""


def generate_words(order: DatasetOrder) -> list[str]:
    """Return the words of `generate` for what an order asks beside its defaults, without `--out`.

    Which part of the dataset this machine makes, and with how many processes, is left out; so are
    passwords.
    """
    words = option_words(order, leave_out=_ELSEWHERE)
    return ["generate", order.build, *map(_shown, words)]


def _shown(word: str) -> str:
    return safe_url(word) if "://" in word and not word.startswith("--") else word


def option_words(order: Any, *, leave_out: tuple[str, ...] = ()) -> list[str]:
    """Return the options of a command that state a class of settings, but for its defaults.

    Args:
        order: an instance.
        leave_out: fields that are no matter.
    """
    kind: Any = type(order)
    return [
        word
        for field in described(kind)
        if field.name not in leave_out and getattr(order, field.name) != field.default
        for word in _words(option_of(field.name), getattr(order, field.name))
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
