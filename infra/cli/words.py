"""Words of the command line as the values of fields, by their types; the classes check them."""

import os
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from infra.cli.changes import parse_changes
from storage.remote.url import parse_local_path


class FileName(Path):
    """The type of an option that takes any text, which is most often a file: shells complete it."""


def value_of(words: bool | str | Sequence[str], hint: Any) -> Any:
    """Return the value that words state for a field.

    Args:
        words: what was typed, several where the field takes several; or whether a switch is set.
        hint: the field's type. A word that is no value of it comes back as it is, for the class to
            say what it expects.

    Raises:
        TrilightError: a field of names with values, of which one is not written NAME=VALUE.
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
    """Return the words of which a field takes one; none where it takes others too."""
    inner = get_args(bare(hint))[0] if is_repeated(hint) else hint
    return tuple(kind for kind in _kinds(inner) if isinstance(kind, str))


def kind_of(hint: Any) -> type:
    """Return the type of one word of a field: bool, int, float, or str for every text."""
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
    """Return what a value may be: types, and the words of a choice."""
    kind = bare(hint)
    if get_origin(kind) in (typing.Union, types.UnionType, Literal):
        return tuple(found for part in get_args(kind) for found in _kinds(part))
    return (kind,)
