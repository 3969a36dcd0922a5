"""Typed parameters of flows, made of our frozen settings: Prefect's forms show names and docs.

A flow takes the fields of a dataclass as its parameters. Types, defaults, ranges (storage.ranges)
and the sentence under each field become the schema that Prefect checks before a run exists, and of
which it draws a form.
The groups of a build's settings become forms within the form, where every field may stay empty.
"""

import ast
import dataclasses
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, create_model

from pipeline.flows.builds import BUILDS
from pipeline.flows.settings import BuildSettings
from pipeline.objects.registry import SOURCES
from storage.ranges import Within

Returned = TypeVar("Returned")


def field_docs(settings: type) -> dict[str, str]:
    """Return the sentence under each field of a dataclass, its bases included, by name."""
    docs: dict[str, str] = {}
    for cls in reversed(settings.__mro__[:-1]):
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
        assert isinstance(tree, ast.ClassDef)
        for field, doc in zip(tree.body, tree.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(doc, ast.Expr)
                and isinstance(doc.value, ast.Constant)
            ):
                docs[field.target.id] = " ".join(str(doc.value.value).split())
    return docs


def parameters_of(settings: type, **annotations: Any) -> Callable[[Any], Any]:
    """Give a function that takes keywords the signature of a dataclass; for flows.

    Args:
        settings: the dataclass.
        annotations: types that take the place of those of some fields.
    """
    docs = field_docs(settings)
    hints = typing.get_type_hints(settings, include_extras=True)

    def with_signature(function: Callable[..., Returned]) -> Callable[..., Returned]:
        parameters, lines = [], []
        for field in dataclasses.fields(settings):
            kind = annotations.get(field.name, _form_type(hints[field.name]))
            default = None if _has_factory(field) else field.default
            if _has_factory(field):
                kind = kind | None
            parameters.append(
                inspect.Parameter(
                    field.name,
                    inspect.Parameter.KEYWORD_ONLY,
                    default=inspect.Parameter.empty if default is dataclasses.MISSING else default,
                    annotation=kind,
                )
            )
            lines.append(f"    {field.name}: {docs[field.name]}")
        function.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        text = inspect.getdoc(function) or ""
        function.__doc__ = "\n".join([text, "", "Args:", *lines])
        return function

    return with_signature


def changes_form(settings: type, example: Any) -> type[BaseModel]:
    """Return a form of all settings of a dataclass in which every field may stay empty.

    Args:
        settings: the dataclass, whose fields may be groups, or tuples of groups.
        example: an instance, which says what the groups within tuples are.
    """
    docs = field_docs(settings)
    hints = typing.get_type_hints(settings, include_extras=True)
    fields: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value, kind = getattr(example, field.name), _form_type(hints[field.name])
        first = value[0] if isinstance(value, tuple) and value else value
        if dataclasses.is_dataclass(first) and not isinstance(first, type):
            kind = changes_form(type(first), first)
        fields[field.name] = (kind | None, Field(default=None, description=docs[field.name]))
    return create_model(
        f"{settings.__name__}Changes", __config__=ConfigDict(extra="forbid"), **fields
    )


def changed_values(form: BaseModel | None) -> dict[str, Any]:
    """Return what was filled in, by dotted name, as `storage.changes` takes it."""
    values: dict[str, Any] = {}
    for name in form.model_fields_set if form else ():
        value = getattr(form, name)
        if isinstance(value, BaseModel):
            values |= {f"{name}.{below}": entry for below, entry in changed_values(value).items()}
        elif value is not None:
            values[name] = value
    return values


def _has_factory(field: "dataclasses.Field[Any]") -> bool:
    return field.default_factory is not dataclasses.MISSING


_EXACT = 2**53
"""Beyond it forms show other numbers than were meant: JavaScript has no larger integers."""


def _form_type(hint: Any, within: Within | None = None) -> Any:
    """Return a type as JSON has it: tuples of one kind are lists, mappings are objects.

    Args:
        hint: the type.
        within: the range of its numbers, where one was declared around it.
    """
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        declared = [note for note in args[1:] if isinstance(note, Within)]
        return _form_type(args[0], declared[0] if declared else within)
    if origin in (typing.Union, types.UnionType):
        return typing.Union[tuple(_form_type(arg, within) for arg in args)]  # noqa: UP007
    if origin is tuple:
        one_kind = args[1:] == (...,) or len(set(args)) == 1
        return list[_form_type(args[0], within)] if one_kind else list[Any]  # type: ignore[misc]
    if origin in (Mapping, dict):
        return dict[str, Any]
    return Annotated[hint, _bounds(within)] if within and hint in (int, float) else hint


def _bounds(within: Within) -> Any:
    """Return a range as pydantic and the schema have it; ends that are no limit are left out."""
    bounds: dict[str, Any] = {}
    if abs(within.low) <= _EXACT:
        bounds["gt" if within.low_open else "ge"] = within.low
    if abs(within.high) <= _EXACT:
        bounds["lt" if within.high_open else "le"] = within.high
    return Field(**bounds)


_NAMED = "|".join(re.escape(name) for name, source in SOURCES.items() if not source.is_place)
_NO_SECRET = (
    rf"^(?:env:TRILIGHT_SOURCE_\w*|(?:{_NAMED}):[^@?]*"
    r"|[A-Za-z][A-Za-z0-9+.\-]*://[^@?#]*|[^:]*)$"
)
"""URLs without a user, a password or a query: whoever may see the server would see them too. The
same holds for variables that are not for sources (pipeline.objects.sources)."""

PublicUrl = Annotated[str, Field(pattern=_NO_SECRET)]
"""A path or URL that may be seen by everybody who sees the server."""
PublicPlace = Annotated[
    str,
    Field(pattern=r"^(?:[A-Za-z][A-Za-z0-9+.\-]*://[^@?#]*|(?:[^:]|:+[^:/]|:+/[^:/])*:*/?)$"),
]
"""The same for a place to write to: a folder of any name, or a URL."""
BuildName = typing.Literal[tuple(BUILDS)]  # type: ignore[valid-type]
"""A list to choose from."""
BuildChanges = changes_form(BuildSettings, BUILDS["smoke"].settings())
"""Every setting of a build."""
