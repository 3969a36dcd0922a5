"""Settings: each is described once, where its field stands, and all else is made from that.

    @checked("render settings")
    class RenderSettings:
        resolution: Annotated[int, Within(8, 2048, unit="pixels")] = 256
        \"\"\"Width of a square picture.\"\"\"

From type, range, unit, sentence and default come the check of every value (pydantic), the complaint
about a wrong one, the command line, Prefect's forms, the page of settings and the records in
manifests and checkpoints. Laws between fields stay in `__post_init__`. What streams shards does not
import this file: tests/architecture/test_light_imports.py.
"""

import ast
import dataclasses
import functools
import inspect
import json
import reprlib
import textwrap
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar, dataclass_transform, get_args, get_origin

import pydantic
from pydantic.dataclasses import dataclass

from storage.errors import TrilightError, expected_one_of
from storage.removed import removal_message
from storage.settings.execution import is_execution
from storage.settings.ranges import Within, declared_ranges

Settings = TypeVar("Settings")

_RULES = pydantic.ConfigDict(
    extra="forbid",
    strict=True,  # "4" is no number, 1 no truth value; a float may be given as a whole number
    allow_inf_nan=False,
    arbitrary_types_allowed=True,
)

_SHORT = reprlib.Repr()
"""Shows wrong values, the long and deep ones in part."""
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 200
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 20

_KINDS = {bool: "true or false", str: "a text", int: "a whole number", float: "a number"}


@dataclass_transform(
    frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field,)
)
def checked(
    called: str = "", *, option: Callable[[str], str] = str
) -> Callable[[type[Settings]], type[Settings]]:
    """Return a decorator that makes a class a frozen dataclass whose values are checked.

    Args:
        called: begins every complaint, such as `render settings`; empty for none.
        option: returns what a field is called where people write it.

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
                raise _complaint(error, type(self), called=called, option=option) from None

        group.__init__ = init_or_complain
        return typing.cast(type[Settings], group)

    return decorate


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldDescription:
    """Description of one field of a class of settings."""

    name: str
    hint: Any
    """Type annotation, with its notes."""
    default: Any
    """Default value; dataclasses.MISSING where a value must be given."""
    sentence: str
    """The sentence under it, in one line."""
    within: Within | None
    """The range of its numbers."""
    expected: str
    """Description of valid values, for error messages."""
    is_execution: bool
    """True: the field changes how something is executed, and not its meaning."""


@functools.cache
def describe_fields(kind: type) -> tuple[FieldDescription, ...]:
    """Return what is said of the fields of a class of settings, in their order."""
    hints = _hints(kind)
    ranges = {field.name: field for field in declared_ranges(kind)}
    sentences = field_sentences(kind)
    return tuple(
        FieldDescription(
            name=field.name,
            hint=hints[field.name],
            default=_default(field),
            sentence=sentences.get(field.name, ""),
            within=ranges[field.name].within if field.name in ranges else None,
            expected=(
                ranges[field.name].expected
                if field.name in ranges
                else expected_of(hints[field.name])
            ),
            is_execution=is_execution(hints[field.name]),
        )
        for field in dataclasses.fields(kind)
    )


def field_sentences(kind: type) -> dict[str, str]:
    """Return what stands under each field of a dataclass, its bases' included, by name.

    Read from the source on demand: pydantic would read it whenever settings are imported.
    """
    sentences: dict[str, str] = {}
    for cls in reversed(kind.__mro__[:-1]):
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        assert isinstance(tree, ast.ClassDef)
        for field, below in zip(tree.body, tree.body[1:], strict=False):
            match field, below:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    sentences[name] = " ".join(text.split())
    return sentences


def removed_fields(kind: type) -> Sequence[str]:
    """Return the names of fields that a class once had (its REMOVED)."""
    names: Sequence[str] = getattr(kind, "REMOVED", ())
    return names


def option_of(field: str) -> str:
    """Return the option of the command line that fills a field."""
    return "--" + field.replace("_", "-")


def expected_of(hint: Any) -> str:
    """Return what a value of a type without a range looks like, for a person."""
    origin = get_origin(hint)
    args = get_args(hint)
    if origin is Annotated:
        stated = (getattr(note, "expected", "") for note in args[1:])
        return next(filter(None, stated), "") or expected_of(args[0])
    if origin is Literal:
        *choices, last = map(str, args)
        return f"{', '.join(choices)} or {last}" if choices else last
    if origin in (typing.Union, types.UnionType):
        return " or ".join("none" if arg is types.NoneType else expected_of(arg) for arg in args)
    if origin is tuple:
        return f"a list, each entry {expected_of(args[0])}"
    if origin in (dict, Mapping) or group_of(hint):
        return "names with values"
    return _KINDS.get(hint, f"a {getattr(hint, '__name__', hint)}".lower())


def group_of(hint: Any) -> bool:
    """Return whether a type is a class of settings, which has fields of its own."""
    return isinstance(hint, type) and dataclasses.is_dataclass(hint)


def settings_record(group: Any, *, stated: bool = False) -> dict[str, Any]:
    """Return settings as JSON values, as manifests and checkpoints hold them.

    Args:
        group: an instance.
        stated: leave out what is at its default; such a record stays what it is when a field is
            added whose default is what was done before.
    """
    adapter = _adapter(typing.cast(Any, type(group)))
    record: dict[str, Any] = adapter.dump_python(group, mode="json", exclude_defaults=stated)
    return record


def from_record(kind: type[Settings], record: Any) -> Settings:
    """Return the settings of a record; what it lacks is at its default.

    Raises:
        TrilightError: a value that they refuse, by its dotted place.
    """
    try:
        return typing.cast(Settings, _read(kind, record))
    except pydantic.ValidationError as error:
        raise _complaint(error, kind, option="setting {!r}".format) from None


def field_value(kind: type, name: str, value: Any, display_name: str) -> Any:
    """Return a JSON value as the value of a field.

    Args:
        kind: the class.
        name: of the field.
        value: as `json.loads` returns it.
        shown: what complaints call the field.

    Raises:
        TrilightError: the value is of another type or outside its range.
    """
    try:
        return _read(_hints(kind)[name], value)
    except pydantic.ValidationError as error:
        raise _complaint(
            error, kind, option="setting {!r}".format, within=(name, display_name)
        ) from None


def _read(hint: Any, value: Any) -> Any:
    return _adapter(hint).validate_json(json.dumps(value))


def strict_adapter(kind: Any) -> "pydantic.TypeAdapter[Any]":
    """Return the strict reader of a type that is made of plain dataclasses; it takes null too."""
    # pydantic takes rules for a union, and hands them on to the plain dataclasses in it
    return pydantic.TypeAdapter(kind | None, config={"extra": "forbid", "strict": True})


def read_error(error: ValueError, kind: Any, source: str) -> TrilightError:
    """Return the complaint of a value of JSON that was read; `source` begins it."""
    assert isinstance(error, pydantic.ValidationError)
    complaint = _complaint(error, kind, called=source, option=str)
    message = str(complaint)
    return complaint if message.startswith(source) else TrilightError(f"{source}: {message}")


@functools.cache
def _hints(kind: type) -> Mapping[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


@functools.cache
def _adapter(hint: Any) -> "pydantic.TypeAdapter[Any]":
    config = None if group_of(hint) else pydantic.ConfigDict(strict=True, allow_inf_nan=False)
    return pydantic.TypeAdapter(hint, config=config)


def _default(field: "dataclasses.Field[Any]") -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _complaint(
    error: pydantic.ValidationError,
    kind: type,
    *,
    called: str = "",
    option: Callable[[str], str],
    within: tuple[str, str] | None = None,
) -> TrilightError:
    """Return what is wrong first: the place, the value and what was expected.

    Args:
        error: what pydantic found.
        kind: the class whose values were read.
        called: begins the complaint.
        option: returns what a dotted place is called where people write it.
        within: the field whose value alone was read, and what is shown of it.
    """
    first = error.errors(include_url=False)[0]
    law = first.get("ctx", {}).get("error")
    if isinstance(law, TrilightError):
        return law
    where = f"{called}: " if called else ""
    if first["type"] == "json_invalid":
        what = f"{option(within[1])} is" if within else "all of it is"
        why = first["ctx"]["error"]
        return TrilightError(f"{where}{what} not JSON ({why}); expected it as it was written.")
    steps = [str(step) for step in first["loc"]]
    known_steps, holder, field = _place([within[0], *steps] if within else steps, kind)
    if within:
        known_steps[0] = within[1]
    place = option(".".join(known_steps)) if known_steps else "all of it"
    if first["type"] in ("unexpected_keyword_argument", "unexpected_property"):
        if steps[-1] in removed_fields(holder):
            return TrilightError(removal_message(f"{where}{place}"))
        known = [each.name for each in describe_fields(holder)]
        return TrilightError(f"{where}{place} does not exist; {expected_one_of(steps[-1], known)}.")
    expected = field.expected if field else expected_of(holder)
    if first["type"].startswith("missing"):
        return TrilightError(f"{where}{place} is missing; expected {expected}.")
    return TrilightError(f"{where}{place} is {_SHORT.repr(first['input'])}; expected {expected}.")


def _place(steps: Sequence[str], kind: type) -> tuple[list[str], type, FieldDescription | None]:
    """Return the steps that a person knows, the class that holds the last, and its field."""
    known_steps = list[str]()
    holder = kind
    field = None
    for step in steps:
        groups = {group.__name__: group for group in _groups(field.hint if field else None)}
        if step in groups:  # of a union of groups, the one that was tried
            holder = groups[step]
            field = None
            continue
        if len(groups) == 1 and not step.isdigit():
            (holder,) = groups.values()
        fields = describe_fields(holder) if group_of(holder) else ()
        field = {each.name: each for each in fields}.get(step, field)
        known_steps.append(step)
    return known_steps, holder, field


def _groups(hint: Any) -> Iterator[type]:
    """Yield the classes of settings that a type is made of."""
    if group_of(hint):
        yield hint
    for part in get_args(hint):
        yield from _groups(part)


def option_words(settings: Any, *, leave_out: tuple[str, ...] = ()) -> list[str]:
    """Return the options of a command that state settings, but for those at their default.

    Args:
        settings: an instance of a class of settings.
        leave_out: fields that are not stated.
    """
    kind: Any = type(settings)
    return [
        word
        for field in describe_fields(kind)
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
