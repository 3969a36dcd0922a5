"""Settings: each is described once, where its field stands, and all else is made from that.

    @checked("render settings")
    class RenderSettings:
        resolution: Annotated[int, Within(8, 2048, unit="pixels")] = 256
        \"\"\"Width of a square picture.\"\"\"

From type, range, unit, sentence and default (storage.settings.fields) come the check of every value
(pydantic), the complaint about a wrong one, the command line, Prefect's forms, the page of settings
and the records in manifests and checkpoints. Laws between fields stay in `__post_init__`. What
streams shards does not import this file: tests/architecture/test_light_imports.py.
"""

import dataclasses
import functools
import json
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import field as dataclass_field
from typing import Any, TypeVar, cast, dataclass_transform

import pydantic
from pydantic.dataclasses import dataclass

from storage.errors import TrilightError, expected_one_of, removal_message
from storage.settings.fields import (
    FieldDescription,
    describe_fields,
    expected_of,
    group_of,
    parts_of,
)

Settings = TypeVar("Settings")

_RULES = pydantic.ConfigDict(
    extra="forbid",
    strict=True,  # "4" is no number, 1 no truth value; a float may be given as a whole number
    allow_inf_nan=False,
    arbitrary_types_allowed=True,
)

_UNKNOWN = ("unexpected_keyword_argument", "unexpected_property")
"""Types of pydantic's errors of a name that is no field."""

_SHORT = reprlib.Repr()
"""Shows wrong values, the long and deep ones in part."""
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 200
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 20


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(dataclass_field,))
def checked(called: str = "") -> Callable[[type[Settings]], type[Settings]]:
    """Return a decorator that makes a class a frozen dataclass whose values are checked.

    `called` begins every complaint, such as `render settings`; empty for none.

    An instance raises TrilightError for the first field whose value is of another type or outside
    its range: the field, the value, and what was expected.
    """

    def decorate(cls: type[Settings]) -> type[Settings]:
        group: Any = dataclass(cls, frozen=True, kw_only=True, config=_RULES)
        plain = group.__init__

        @functools.wraps(plain)
        def init_or_complain(self: Any, **values: Any) -> None:
            try:
                plain(self, **values)
            except pydantic.ValidationError as error:
                raise _complaint(error, type(self), called=called) from None

        group.__init__ = init_or_complain
        return group

    return decorate


def leaves_out(*names: str) -> Any:
    """Return the serializer of a class whose record lacks later fields at their defaults.

    Digests of earlier presets stay so. It works as an attribute of the class, whatever its name.
    """

    @pydantic.model_serializer(mode="wrap")
    def record(self: Any, as_usual: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        later = {each.name: each.default for each in dataclasses.fields(self) if each.name in names}
        usual: dict[str, Any] = as_usual(self)
        return {k: v for k, v in usual.items() if k not in later or getattr(self, k) != later[k]}

    return record


def settings_record(group: Any) -> dict[str, Any]:
    """Return settings as JSON values, as manifests and checkpoints hold them."""
    return _adapter(cast(Any, type(group))).dump_python(group, mode="json")


def from_record(kind: type[Settings], record: Any) -> Settings:
    """Return the settings of a record; what it lacks is at its default.

    Raises:
        TrilightError: a value that they refuse, by its dotted place.
    """
    return _read(record, kind, kind)


def field_value(kind: type, field: FieldDescription, value: Any, display_name: str) -> Any:
    """Return a JSON value as the value of a field of `kind`, which complaints call `display_name`.

    Raises:
        TrilightError: the value is of another type or outside its range.
    """
    return _read(value, field.hint, kind, field=field, display_name=display_name)


def _read(value: Any, hint: Any, kind: type, **place: Any) -> Any:
    try:
        return _adapter(hint).validate_json(json.dumps(value))
    except pydantic.ValidationError as error:
        raise _complaint(error, kind, option="setting {!r}".format, **place) from None


def parse_strictly(data: bytes | str, kind: Any, source: str) -> Any:
    """Return the value of a JSON text, of a type that is made of plain dataclasses, or None.

    Raises:
        TrilightError: other JSON than the type says; `source` begins the complaint.
    """
    try:
        return _strict_adapter(kind).validate_json(data)
    except pydantic.ValidationError as error:
        complaint = str(_complaint(error, kind, called=source))
    raise TrilightError(complaint if complaint.startswith(source) else f"{source}: {complaint}")


@functools.cache
def _strict_adapter(kind: Any) -> "pydantic.TypeAdapter[Any]":
    # pydantic takes rules for a union, and hands them on to the plain dataclasses in it
    return pydantic.TypeAdapter(kind | None, config={"extra": "forbid", "strict": True})


@functools.cache
def _adapter(hint: Any) -> "pydantic.TypeAdapter[Any]":
    config = None if group_of(hint) else pydantic.ConfigDict(strict=True, allow_inf_nan=False)
    return pydantic.TypeAdapter(hint, config=config)


def _complaint(
    error: pydantic.ValidationError,
    kind: type,
    *,
    called: str = "",
    option: Callable[[str], str] = str,
    field: FieldDescription | None = None,
    display_name: str = "",
) -> TrilightError:
    """Return what is wrong first: the place, the value and what was expected.

    Args:
        error: what pydantic found.
        kind: the class whose values were read.
        called: begins the complaint.
        option: returns what a dotted place is called where people write it.
        field: the field whose value alone was read.
        display_name: what is shown of that field.
    """
    mistakes = error.errors(include_url=False)
    # a name that is unknown says more than the one that lacks then
    first = next((each for each in mistakes if each["type"] in _UNKNOWN), mistakes[0])
    law = first.get("ctx", {}).get("error")
    if isinstance(law, TrilightError):
        return law
    steps = [str(step) for step in first["loc"]]
    known_steps, holder, field = _place(steps, kind, field)
    names = [display_name, *known_steps] if display_name else known_steps
    place = option(".".join(names)) if names else "all of it"
    where = f"{called}: {place}" if called else place
    if first["type"] == "json_invalid":
        return TrilightError(f"{where} is not JSON ({law}); expected it as it was written.")
    if first["type"] in _UNKNOWN:
        if steps[-1] in getattr(holder, "REMOVED", ()):
            return TrilightError(removal_message(where))
        known = [each.name for each in describe_fields(holder)]
        return TrilightError(f"{where} does not exist; {expected_one_of(steps[-1], known)}.")
    expected = field.expected if field else expected_of(holder)
    if first["type"].startswith("missing"):
        return TrilightError(f"{where} is missing; expected {expected}.")
    return TrilightError(f"{where} is {_SHORT.repr(first['input'])}; expected {expected}.")


def _place(
    steps: Sequence[str], holder: type, field: FieldDescription | None
) -> tuple[list[str], type, FieldDescription | None]:
    """Return the steps that a person knows, the class that holds the last, and its field."""
    known_steps = list[str]()
    for step in steps:
        groups = [part for part in parts_of(field.hint) if group_of(part)] if field else []
        tried = [group for group in groups if group.__name__ == step]
        if tried:  # of a union of groups, the one that was tried
            holder = tried[-1]
            field = None
            continue
        if len(groups) == 1 and not step.isdigit():
            holder = groups[0]
        fields = describe_fields(holder) if group_of(holder) else ()
        field = {each.name: each for each in fields}.get(step, field)
        known_steps.append(step)
    return known_steps, holder, field
