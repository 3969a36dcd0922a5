"""Builds a reader of results from a function's return type; the bytes choose no class.

Supported are dataclasses, numpy arrays, tuples, lists, mappings by text or int, `None`, bool, int,
float, str, bytes, `Path`, `Literal`, unions of these, and `Any` for JSON values.
"""

import dataclasses
import functools
import os
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

import numpy as np
from numpy.typing import NDArray
from pydantic_core import SchemaValidator, ValidationError
from pydantic_core import core_schema as core

from pipeline.isolation.answers import CLASS
from storage.settings.fields import array_scalar

DTYPES = [np.dtype(code).name for code in "?bhiqBHIQefd"]
"""Names of the supported array dtypes."""


@functools.cache
def result_reader(function: Callable[..., Any]) -> SchemaValidator:
    """Return the strict validator of a function's result; without a return type it must be None.

    Raises:
        TypeError: a value of the declared type could not be checked.
    """
    declares = hasattr(function, "__annotations__")  # builtins have none
    hint: Any = typing.get_type_hints(function).get("return") if declares else None
    schema = schema_of(None if hint is NoReturn else hint)
    return SchemaValidator(schema, core.CoreConfig(strict=True))


def first_wrong(error: Exception) -> str:
    """Return the position and reason of the first wrong value, or the name of another error."""
    if not isinstance(error, ValidationError):
        return type(error).__name__
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def schema_of(hint: Any) -> core.CoreSchema:
    """Return the schema of an annotation; raises TypeError if it cannot be checked."""
    origin = get_origin(hint)
    args = get_args(hint)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is Literal:
        return core.literal_schema(list(args))
    if origin in (typing.Union, types.UnionType):
        return core.union_schema([schema_of(each) for each in args])
    if (scalar := array_scalar(hint)) is not None:
        return _array(scalar)
    if origin is tuple and args[-1] is not Ellipsis:
        return core.tuple_schema([schema_of(each) for each in args])
    if origin in (tuple, Sequence):
        return _row(schema_of(args[0]))
    if origin is list:
        return core.list_schema(schema_of(args[0]))
    if origin in (dict, Mapping) and args[0] in (str, int):  # the keys of JSON are texts
        return core.dict_schema(_PLAIN[args[0]], schema_of(args[1]))
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _record(hint)
    raise TypeError(f"{hint} cannot be checked when it comes from a child; declare what it is.")


def _row(each: core.CoreSchema) -> core.CoreSchema:
    return core.tuple_schema([each], variadic_item_index=0)


def _record(kind: type) -> core.CoreSchema:
    """Return the schema of a dataclass; values are made by its constructor, with its checks."""
    hints = typing.get_type_hints(kind)
    names = [field.name for field in dataclasses.fields(kind) if field.init]
    fields = {name: core.typed_dict_field(schema_of(hints[name])) for name in names}
    fields[CLASS] = core.typed_dict_field(core.literal_schema([kind.__name__]))
    return core.no_info_after_validator_function(
        lambda read: kind(**{name: read[name] for name in names}),
        core.typed_dict_schema(fields, extra_behavior="forbid"),
    )


def _array(scalar: Any) -> core.CoreSchema:
    """Return the schema of arrays of one dtype, or of all dtypes of an abstract one."""
    kind = scalar if isinstance(scalar, type) and issubclass(scalar, np.generic) else np.generic

    def read(data: tuple[int, str, tuple[int, ...], Any], info: Any) -> NDArray[Any]:
        number, name, shape, order = data
        part = info.context[number]
        if name == "bool":
            np.minimum(part, 1, out=part)
        return part.view(name).reshape(shape, order=order)

    names = [name for name in DTYPES if np.issubdtype(name, kind)]
    return core.with_info_after_validator_function(
        read,
        core.tuple_schema(
            [_COUNT, core.literal_schema(names), _row(_COUNT), core.literal_schema(["C", "F"])]
        ),
    )


def _read_bytes(number: int, info: Any) -> bytes:
    """Return a part as bytes; all values that refer to it share one copy."""
    parts = info.context
    if not isinstance(parts[number], bytes):
        parts[number] = parts[number].tobytes()
    return typing.cast(bytes, parts[number])


_COUNT = core.int_schema(ge=0)
_INT = core.int_schema()
_PLAIN: Mapping[Any, core.CoreSchema] = {
    None: core.none_schema(),
    types.NoneType: core.none_schema(),
    bool: core.bool_schema(),
    int: _INT,
    float: core.union_schema([_INT, core.float_schema()]),  # 1 does not become 1.0
    str: core.str_schema(),
    bytes: core.with_info_after_validator_function(_read_bytes, _COUNT),
    Path: core.with_info_after_validator_function(
        lambda number, info: Path(os.fsdecode(_read_bytes(number, info))), _COUNT
    ),
    Any: core.any_schema(),
}
