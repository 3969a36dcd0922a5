"""Settings with some values changed, by dotted names such as `lights.count`.

A name leads through groups of settings; where it leads through a list of groups, each of them is
changed. Values come as JSON has them, and must be of the kind that they replace.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from storage.errors import TrilightError

Settings = TypeVar("Settings")


def changed(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Return settings, a frozen dataclass, with the named values replaced.

    Raises:
        TrilightError: a name that does not exist, a value of another kind, or one that the
            settings themselves refuse.
    """
    for name, value in changes.items():
        try:
            settings = _changed(settings, name.split("."), value, name)
        except TrilightError as error:
            if name in str(error):
                raise
            raise TrilightError(f"setting {name!r}: {error}") from error
    return settings


def _changed(group: Any, path: list[str], value: Any, name: str) -> Any:
    if isinstance(group, tuple) and group and dataclasses.is_dataclass(group[0]):
        return tuple(_changed(entry, path, value, name) for entry in group)
    names = [field.name for field in dataclasses.fields(group)]
    if path[0] not in names:
        raise TrilightError(
            f"setting {name!r} does not exist; expected one of {', '.join(names)} in place of "
            f"{path[0]!r}."
        )
    old = getattr(group, path[0])
    is_group = dataclasses.is_dataclass(old) or (
        isinstance(old, tuple) and bool(old) and dataclasses.is_dataclass(old[0])
    )
    if is_group != (len(path) > 1):
        kind = "a group: name one of its settings" if is_group else "a single setting"
        raise TrilightError(f"setting {name!r}: {path[0]!r} is {kind}.")
    new = _changed(old, path[1:], value, name) if is_group else _like(old, value, name)
    return dataclasses.replace(group, **{path[0]: new})


def _like(old: Any, value: Any, name: str) -> Any:
    """Return a JSON value as the kind of the value that it replaces."""
    if isinstance(value, list):
        value = tuple(value)
    if not _same_kind(old, value):
        shown = list(old) if isinstance(old, tuple) else old
        raise TrilightError(f"setting {name!r} is {value!r}; expected something like {shown!r}.")
    if isinstance(old, tuple) and all(isinstance(part, float) for part in old):
        return tuple(float(part) for part in value)
    return float(value) if isinstance(old, float) else value


def _same_kind(old: Any, value: Any) -> bool:
    if isinstance(old, bool) or isinstance(value, bool):
        return isinstance(old, bool) and isinstance(value, bool)
    if isinstance(old, tuple):
        if not isinstance(value, tuple):
            return False
        if not old:
            return not value
        of_numbers = all(_is_number(part) for part in old)
        return all(_is_number(part) == of_numbers for part in value)
    if isinstance(old, float):
        return isinstance(value, int | float)
    return old is None or isinstance(value, type(old))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
