"""Converts words of the command line to values by the types of fields; the classes check them."""

import os
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from infra.cli.changes import parse_changes
from storage.remote.url import parse_local_path


class FileName(Path):
    """Type of an option that takes any text; shells complete it as a file name."""


def value_of(words: bool | str | Sequence[str], hint: Any) -> Any:
    """Return the value of a field from its words.

    Args:
        words: the typed word, a list for a field that takes several, or a bool for a switch.
        hint: type of the field. A word that is no value of it is returned unchanged, so that the
            class reports what it expects.

    Raises:
        TrilightError: the field takes names with values, and a word is not NAME=VALUE.
    """
    if isinstance(words, bool):
        return words
    if isinstance(words, str):
        return _one(words, hint)
    if takes_names(hint):
        return parse_changes(words)
    return tuple(_one(word, get_args(bare(hint))[0]) for word in words)


def _one(word: str, hint: Any) -> Any:
    word = os.path.expanduser(word)  # a shell leaves the ~ of --out=~/x as it is
    for kind, parse in ((int, int), (float, float), (Path, parse_local_path)):
        if kind in _kinds(hint):
            try:
                return parse(word)
            except ValueError:
                pass
    return word


def choices_of(hint: Any) -> tuple[str, ...]:
    """Return the choices of a field; empty where it takes other words too."""
    inner = get_args(bare(hint))[0] if is_repeated(hint) else hint
    return tuple(kind for kind in _kinds(inner) if isinstance(kind, str))


def kind_of(hint: Any) -> type:
    """Return the type of one word of a field: bool, int, float, or str for any text."""
    inner = get_args(bare(hint))[0] if is_repeated(hint) else hint
    return next((kind for kind in (bool, int, float) if kind in _kinds(inner)), str)


def is_repeated(hint: Any) -> bool:
    """Return whether a field takes several words."""
    return get_origin(bare(hint)) is tuple


def takes_names(hint: Any) -> bool:
    """Return whether a field takes names with values."""
    return get_origin(bare(hint)) in (Mapping, dict)


def bare(hint: Any) -> Any:
    """Return a type without its notes and without None."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in get_args(hint) if kind is not types.NoneType]
        return bare(kinds[0]) if len(kinds) == 1 else hint
    return hint


def _kinds(hint: Any) -> tuple[Any, ...]:
    """Return the types and the choices that a value may be."""
    kind = bare(hint)
    if get_origin(kind) in (typing.Union, types.UnionType, Literal):
        return tuple(inner for part in get_args(kind) for inner in _kinds(part))
    return (kind,)
