"""Settings overrides: some values replaced, by dotted names such as `lights.count`.

A name leads through groups of settings, and through a list of them by the number of an entry, as in
`families.0.weight`; without a number each entry is changed. Values come as JSON has them, lists and
whole groups included. A group whose class has `PRESETS`, makers by name, may also be replaced by
the name of one, and a list of such groups by names; single settings of it are then changes of the
preset: model=large with model.window_bundles=0.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from storage.errors import OF_EXTENSION, TrilightError, expected_one_of, removal_message
from storage.extensions import mistakes_of_entry
from storage.settings.described import field_value, settings_record
from storage.settings.fields import describe_fields, shown_name

Settings = TypeVar("Settings")


_LIST_OF_WORDS = re.compile(r"\[(\s*[A-Za-z]\w*\s*(?:,\s*[A-Za-z]\w*\s*)*)\]")

Override = tuple[Sequence[str], Any, str]
"""The way that is left to a value, the value, and the whole name."""


def json_or_word(text: str) -> Any:
    """Return the JSON value that a text is, or the text: what a person writes as a value.

    Words in a list need no quotes either: [depth,normal].

    Raises:
        TrilightError: a number of thousands of digits, or values nested hundreds deep.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        listed = _LIST_OF_WORDS.fullmatch(text)
        return text if listed is None else [word.strip() for word in listed[1].split(",")]
    except (ValueError, RecursionError) as error:
        raise TrilightError(
            f"{text:.40}... has too many digits or is nested too deeply; expected a value."
        ) from error


def option_words(settings: Any, *, leave_out: tuple[str, ...] = ()) -> list[str]:
    """Return the options of a command that state settings, but for those at their default.

    Args:
        settings: an instance of a class of settings.
        leave_out: fields that are not stated.
    """
    kind: Any = type(settings)
    words: list[str] = []
    for field in describe_fields(kind):
        value = getattr(settings, field.name)
        if field.name in leave_out or value == field.default:
            continue
        if isinstance(value, bool):
            words.append(shown_name(field))
            continue
        if isinstance(value, Mapping):
            value = tuple(f"{name}={_write_value(new)}" for name, new in value.items())
        for entry in value if isinstance(value, tuple) else (value,):
            words += (shown_name(field), str(entry))
    return words


def _write_value(value: Any) -> str:
    """Return a value as `json_or_word` reads it: a word stands for itself."""
    is_word = isinstance(value, str) and json_or_word(value) == value
    return value if is_word else json.dumps(value)


def apply_overrides(settings: Settings, overrides: Mapping[str, Any]) -> Settings:
    """Return settings, a frozen dataclass, with the values of overrides, all at once.

    Values that only fit each other may therefore come in any order.

    Raises:
        TrilightError: a name that does not exist, a value of another kind, or one that the
            settings themselves refuse; a name that is nearly right is asked back.
    """
    return _replace_fields(settings, [(n.split("."), v, n) for n, v in overrides.items()])


def values_by_name(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) for each value of a record; groups in lists have numbers."""
    groups = value if isinstance(value, Mapping) else {}
    if isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        groups = {str(place): group for place, group in enumerate(value)}
    if not groups:
        yield name, value
    for below, each in groups.items():
        yield from values_by_name(each, f"{name}.{below}" if name else below)


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], prefix: str = "", *, alike: bool = False
) -> Iterator[tuple[str, Any, Any]]:
    """Yield (dotted name, value before, value now) for each value of two records that differs.

    Args:
        before, now: records (storage.settings.described.settings_record), or parts of them.
        prefix: begins the names.
        alike: compare groups that have other names as a whole.
    """
    for name in sorted({*before, *now}):
        old = before.get(name)
        new = now.get(name)
        if (
            isinstance(old, Mapping)
            and isinstance(new, Mapping)
            and (not alike or old.keys() == new.keys())
        ):
            yield from differences(old, new, f"{prefix}{name}.", alike=alike)
        elif old != new:
            yield f"{prefix}{name}", old, new


def _replace_fields(group: Any, overrides: Sequence[Override]) -> Any:
    kind: Any = type(group)
    fields = {field.name: field for field in describe_fields(kind)}
    by_field: dict[str, list[Override]] = {}
    for path, value, name in overrides:
        first, *rest = path
        if first in getattr(kind, "REMOVED", ()):
            raise TrilightError(removal_message(f"setting {name!r}"))
        if first not in fields:
            raise TrilightError(
                f"setting {name!r} does not exist: {first!r} is unknown there; "
                f"{expected_one_of(first, fields)}."
            )
        by_field.setdefault(first, []).append((rest, value, name))
    values: dict[str, Any] = {}
    for field, inner in by_field.items():
        value = getattr(group, field)
        for path, new, name in inner:
            if not path:  # first as a whole, then single settings within it
                record = _without_presets(new, value, name)
                value = field_value(kind, fields[field], record, name)
        values[field] = _override_within(value, [override for override in inner if override[0]])
    try:
        return dataclasses.replace(group, **values)
    except TrilightError as error:
        names = [name for _, _, name in overrides]
        if any(name in str(error) for name in names):
            raise
        quoted = ", ".join(map(repr, names))
        raise TrilightError(f"setting{'s' * (len(names) > 1)} {quoted}: {error}") from error


def _without_presets(new: Any, old: Any, name: str) -> Any:
    """Return a new value with the record of a preset wherever its name stands."""
    many = isinstance(old, tuple) and bool(old)
    first = old[0] if many else old
    if not dataclasses.is_dataclass(first) or new == []:
        return new
    presets: Mapping[str, Callable[[], Any]] = getattr(first, "PRESETS", {})
    entries = new if many and isinstance(new, list) else [new]
    records = []
    for each in entries:
        if isinstance(each, str) and each in presets:
            with mistakes_of_entry(f"{name} {each!r}"):
                each = settings_record(presets[each]())
        elif not isinstance(each, Mapping):
            known = f"{expected_one_of(str(each), presets)}, {OF_EXTENSION}, or"
            choices = known if presets else "expected"
            raise _no_group(new, name, first, choices)
        records.append(each)
    return records if many else records[0]


def _no_group(new: Any, name: str, group: Any, choices: str = "expected") -> TrilightError:
    return TrilightError(
        f"setting {name!r} is {new!r}; {choices} one of its settings by name, such as "
        f"{name}.{dataclasses.fields(group)[0].name}, since it is a group."
    )


def _override_within(value: Any, overrides: Sequence[Override]) -> Any:
    """Return a group, or a list of groups, with single settings of it changed."""
    if not overrides:
        return value
    if dataclasses.is_dataclass(value):
        for path, new, name in overrides:
            if not path:
                raise _no_group(new, name, value)
        return _replace_fields(value, overrides)
    if not isinstance(value, tuple) or not all(map(dataclasses.is_dataclass, value)):
        path, _, name = overrides[0]
        plain = ".".join(name.split(".")[: -len(path)])
        raise TrilightError(f"setting {name!r} does not exist: {plain!r} has no settings within.")
    by_entry: list[list[Override]] = [[] for _ in value]
    for path, new, name in overrides:
        if not path[0].isdigit():  # all entries are meant
            for entry in by_entry:
                entry.append((path, new, name))
        elif int(path[0]) < len(value):
            by_entry[int(path[0])].append((path[1:], new, name))
        else:
            raise TrilightError(
                f"setting {name!r} does not exist: the list has {len(value)} entries; expected a "
                f"number from 0 to {len(value) - 1}."
            )
    return tuple(map(_override_within, value, by_entry))
