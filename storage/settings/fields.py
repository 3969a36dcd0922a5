"""What the declaration of a field says: type, default, range, sentence, and valid values.

The checks, complaints, options, forms and pages are made from these descriptions. Nothing here
imports pydantic, because readers of scenes do without it.
"""

import ast
import dataclasses
import functools
import inspect
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from storage.settings.ranges import EXECUTION, LowFirst, Within, shown_number

_KINDS = {bool: "true or false", str: "a text", int: "a whole number", float: "a number"}

_NUMBERS = {int: "whole numbers", float: "numbers"}


SHOWN = {
    "allow_licences": "--allow-licence",
    "arc_deg": "--arc",
    "begin_with": "--from",
    "changes": "--set",
    "decisions": "--change",
    "error_db": "--error",
    "exposure_ev": "--exposure",
    "LeaderboardOptions.scenes": "--max-scenes",
    "LeaderboardOptions.width": "--resolution",
    "InspectOptions.scenes": "--max-scenes",
    "hang_after_s": "--hang-after",
    "min_noise_floor_db": "--min-noise-floor",
    "most_scenes": "--max-scenes",
    "most_unusable": "--skip-unusable",
    "noise_floor_db": "--noise-floor",
    "noise_floor_linear_db": "--noise-floor-linear",
    "noise_floor_objects_db": "--noise-floor-objects",
    "other_networks": "--beside",
    "samples": "--probe-scenes",
    "shards": "--range",
}
"""Name of an option that help shows, by field or Class.field, where the field's own name is not the
best for people; that one works too."""


@dataclass(frozen=True, kw_only=True)
class FieldDescription:
    """Description of one field of a dataclass."""

    owner: type
    name: str
    hint: Any
    bare: Any
    """The type without its notes and without None."""
    notes: Sequence[Any]
    """Annotated metadata in order: ranges, laws, marks."""

    @property
    def default(self) -> Any:
        """Default value; dataclasses.MISSING where a value must be given."""
        field = self.owner.__dataclass_fields__[self.name]  # type: ignore[attr-defined]
        make = field.default_factory
        return field.default if make is dataclasses.MISSING else make()

    @property
    def sentence(self) -> str:
        """The sentence under the field, in one line."""
        return field_sentences(self.owner).get(self.name, "")

    @property
    def within(self) -> Within | None:
        """The range of its numbers."""
        return next((note for note in self.notes if isinstance(note, Within)), None)

    @property
    def is_execution(self) -> bool:
        """True: the field changes how something is executed, and not its meaning."""
        return EXECUTION in self.notes

    @property
    def kind(self) -> type:
        """Int or float, of a field with a range; a float may be given as an int."""
        return float if float in parts_of(self.bare) else int

    @property
    def shape(self) -> Literal["one", "pair", "many"]:
        """Of a field with a range: a number, a pair, or a tuple of any length."""
        if get_origin(self.bare) is not tuple:
            return "one"
        return "many" if get_args(self.bare)[1] is ... else "pair"

    @property
    def expected(self) -> str:
        """Description of valid values, for error messages; not for arrays."""
        if self.within is None:
            return expected_of(self.hint)
        numbers = _NUMBERS[self.kind]
        several = "three" if len(get_args(self.bare)) == 3 else "two"
        shapes = {"one": _KINDS[self.kind], "pair": f"{several} {numbers}", "many": numbers}
        order = ", the lower one first" if LowFirst() in self.notes else ""
        return f"{shapes[self.shape]} {self.within}{order}"


@functools.cache
def describe_fields(kind: type) -> tuple[FieldDescription, ...]:
    """Return the descriptions of the fields of a dataclass, in their order."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return tuple(
        FieldDescription(
            owner=kind, name=field.name, hint=hints[field.name], bare=bare, notes=notes
        )
        for field in dataclasses.fields(kind)
        for bare, notes in [unwrap(hints[field.name])]
    )


@functools.cache
def field_sentences(kind: type) -> Mapping[str, str]:
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


def unwrap(hint: Any) -> tuple[Any, list[Any]]:
    """Return a type without its notes and without None, and the notes."""
    args = get_args(hint)
    if get_origin(hint) is Annotated:
        bare, inner_notes = unwrap(args[0])
        return bare, [*args[1:], *inner_notes]
    if get_origin(hint) in (typing.Union, types.UnionType) and types.NoneType in args:
        kinds = tuple(kind for kind in args if kind is not types.NoneType)
        return unwrap(typing.Union[kinds])  # noqa: UP007
    return hint, []


def parts_of(hint: Any) -> Iterator[Any]:
    """Yield the types and choices that a type is made of, without notes."""
    hint, _ = unwrap(hint)
    if get_args(hint):
        for part in get_args(hint):
            yield from parts_of(part)
    else:
        yield hint


def array_scalar(hint: Any) -> Any:
    """Return X of NDArray[X], or None where an annotation is none of arrays.

    Until numpy 2.4 NDArray[X] is ndarray[shape, dtype[X]]; from 2.5 on it is an alias that keeps X.
    """
    origin = get_origin(hint)
    args = get_args(hint)
    if origin is np.ndarray:
        (scalar,) = get_args(args[1])
        return scalar
    return args[0] if origin is NDArray else None


def group_of(hint: Any) -> bool:
    """Return whether a type is a class of settings, which has fields of its own."""
    return isinstance(hint, type) and dataclasses.is_dataclass(hint)


def option_of(field: str) -> str:
    """Return the option of the command line that fills a field."""
    return "--" + field.replace("_", "-")


def shown_name(field: FieldDescription) -> str:
    """Return the name of a field's option that help shows."""
    by_class = SHOWN.get(f"{field.owner.__name__}.{field.name}")
    return by_class or SHOWN.get(field.name) or option_of(field.name)


def expected_of(hint: Any) -> str:
    """Return what a value of a type without a range looks like, for a person."""
    origin = get_origin(hint)
    args = get_args(hint)
    if origin is Annotated:
        stated = (getattr(note, "expected", "") for note in args[1:])
        plain = " ".join(
            [expected_of(args[0]), *(str(n) for n in args[1:] if isinstance(n, Within))]
        )
        return next(filter(None, stated), plain)
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


def default_text(default: Any, *, quote: str = "") -> str:
    """Return a default value for a person; `quote` stands around each word."""
    if isinstance(default, tuple):
        return ", ".join(default_text(entry, quote=quote) for entry in default)
    is_number = isinstance(default, int | float)
    return shown_number(default) if is_number else f"{quote}{default}{quote}"
