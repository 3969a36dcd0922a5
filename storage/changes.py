"""Settings with some values changed, by dotted names such as `lights.count`.

A name leads through groups of settings; where it leads through a list of groups, each of them is
changed. Values come as JSON has them, and must be of the kind that they replace. A group whose
class has `PRESETS`, makers by name, may also be replaced as a whole by one of those, and single
settings of it are then changes of the preset: model=large with model.window_bundles=0. A list of
such groups may be replaced by a list of names.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from storage.errors import TrilightError
from storage.suggestion import expected_one_of

Settings = TypeVar("Settings")


Change = tuple[Sequence[str], Any, str]
"""The way that is left to a value, the value, and the whole name."""


def changed(settings: Settings, changes: Mapping[str, Any]) -> Settings:
    """Return settings, a frozen dataclass, with the named values replaced, all at once.

    Values that only fit each other may therefore come in any order.

    Raises:
        TrilightError: a name that does not exist, a value of another kind, or one that the
            settings themselves refuse; a name that is nearly right is asked back.
    """
    found: Settings = _changed(settings, [(n.split("."), v, n) for n, v in changes.items()])
    return found


def _changed(group: Any, changes: Sequence[Change]) -> Any:
    if not changes:
        return group
    if _is_group(group) and isinstance(group, tuple):
        return tuple(_changed(entry, changes) for entry in group)
    values = {}
    for field, own in _by_field(group, changes).items():
        old = getattr(group, field)
        if _is_group(old):
            inner = [(path[1:], value, name) for path, value, name in own]
            base = _preset(old, [change for change in inner if not change[0]])
            values[field] = _changed(base, [change for change in inner if change[0]])
        else:
            ((_, value, name),) = own
            values[field] = _like(old, value, name)
    try:
        return dataclasses.replace(group, **values)
    except TrilightError as error:
        names = [name for _, _, name in changes]
        if any(name in str(error) for name in names):
            raise
        shown = ", ".join(map(repr, names))
        raise TrilightError(f"setting{'s' * (len(names) > 1)} {shown}: {error}") from error


def _by_field(group: Any, changes: Sequence[Change]) -> Mapping[str, Sequence[Change]]:
    """Return the changes by the field of the group that they lead through."""
    fields = [field.name for field in dataclasses.fields(group)]
    found: dict[str, list[Change]] = {}
    for path, value, name in changes:
        if path[0] not in fields:
            raise TrilightError(
                f"setting {name!r} does not exist: {path[0]!r} is unknown there; "
                f"{expected_one_of(path[0], fields)}."
            )
        old = getattr(group, path[0])
        if _is_group(old) and len(path) == 1 and not _presets(old):
            raise TrilightError(
                f"setting {name!r}: {path[0]!r} is a group: name one of its settings."
            )
        if not _is_group(old) and len(path) > 1:
            raise TrilightError(f"setting {name!r}: {path[0]!r} is a single setting.")
        found.setdefault(path[0], []).append((path, value, name))
    return found


def _presets(group: Any) -> Mapping[str, Callable[[], Any]]:
    """Return what a group may be replaced by, by name."""
    return getattr(group[0] if isinstance(group, tuple) else group, "PRESETS", {})


def _preset(group: Any, changes: Sequence[Change]) -> Any:
    """Return the preset that was named for a group, or the group where none was.

    For a list of groups a list of presets may be named.
    """
    presets, many = _presets(group), isinstance(group, tuple)
    for _, value, name in changes:
        named = value if many and isinstance(value, list) and value else [value]
        unknown = [each for each in named if not isinstance(each, str) or each not in presets]
        if unknown:
            first = dataclasses.fields(group[0] if many else group)[0].name
            raise TrilightError(
                f"setting {name!r} is {value!r}; {expected_one_of(str(unknown[0]), presets)}, or "
                f"one of its settings by name, such as {name}.{first}."
            )
        made = tuple(presets[each]() for each in named)
        group = made if many else made[0]
    return group


def _is_group(value: Any) -> bool:
    first = value[0] if isinstance(value, tuple) and value else value
    return dataclasses.is_dataclass(first)


def _like(old: Any, value: Any, name: str) -> Any:
    """Return a JSON value as the kind of the value that it replaces."""
    if isinstance(value, list):
        value = tuple(value)
    if not _same_kind(old, value):
        shown = list(old) if isinstance(old, tuple) else old
        expected = "true or false" if isinstance(old, bool) else f"something like {shown!r}"
        raise TrilightError(f"setting {name!r} is {value!r}; expected {expected}.")
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
