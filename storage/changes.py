"""Settings with some values changed, by dotted names such as `lights.count`.

A name leads through groups of settings, and through a list of them by the number of an entry, as in
`families.0.weight`; without a number each entry is changed. Values come as JSON has them, lists and
whole groups included. A group whose class has `PRESETS`, makers by name, may also be replaced by
one of those, and single settings of it are then changes of the preset: model=large with
model.window_bundles=0.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from storage.errors import TrilightError
from storage.settings import field_value
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
    values = {
        field: _changed_field(group, field, own) for field, own in _by_field(group, changes).items()
    }
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
        found.setdefault(path[0], []).append((path[1:], value, name))
    return found


def _changed_field(group: Any, field: str, changes: Sequence[Change]) -> Any:
    """Return a field's new value: first as a whole, then single settings within it."""
    value = getattr(group, field)
    for path, new, name in changes:
        if not path:
            value = _whole(type(group), field, value, new, name)
    return _within(value, [change for change in changes if change[0]])


def _whole(kind: type, field: str, old: Any, new: Any, name: str) -> Any:
    presets: Mapping[str, Callable[[], Any]] = getattr(old, "PRESETS", {})
    if presets and not isinstance(new, Mapping):
        if not isinstance(new, str) or new not in presets:
            raise TrilightError(
                f"setting {name!r} is {new!r}; {expected_one_of(str(new), presets)}, or one of its "
                f"settings by name, such as {name}.{dataclasses.fields(old)[0].name}."
            )
        return presets[new]()
    if dataclasses.is_dataclass(old) and not isinstance(new, Mapping):
        raise TrilightError(
            f"setting {name!r} is {new!r}, but it is a group; expected names with values, or one "
            f"of its settings by name, such as {name}.{dataclasses.fields(old)[0].name}."
        )
    return field_value(kind, field, new, name)


def _within(value: Any, changes: Sequence[Change]) -> Any:
    """Return a group, or a list of groups, with single settings of it changed."""
    if not changes:
        return value
    if dataclasses.is_dataclass(value):
        for path, new, name in changes:
            if not path:
                raise TrilightError(
                    f"setting {name!r} is {new!r}; expected one of its settings by name, such as "
                    f"{name}.{dataclasses.fields(value)[0].name}."
                )
        return _changed(value, changes)
    if not isinstance(value, tuple) or not all(map(dataclasses.is_dataclass, value)):
        _, _, name = changes[0]
        raise TrilightError(f"setting {name!r} does not exist: it leads into a single setting.")
    own: list[list[Change]] = [[] for _ in value]
    for path, new, name in changes:
        for index in _entries(path[0], len(value), name):
            inner = path[1:] if path[0].isdigit() else path
            own[index].append((inner, new, name))
    return tuple(map(_within, value, own))


def _entries(step: str, count: int, name: str) -> Sequence[int]:
    """Return which entries of a list a step means: the one of its number, or all."""
    if not step.isdigit():
        return range(count)
    if int(step) >= count:
        raise TrilightError(
            f"setting {name!r} does not exist: the list has {count} entries; expected a number "
            f"from 0 to {count - 1}."
        )
    return [int(step)]
