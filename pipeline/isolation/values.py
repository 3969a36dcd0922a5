"""Values as bytes that cannot run code, in the form that an annotation declares.

What comes back from a process that may have been taken over is made of its declared type alone: the
bytes choose no class, no dtype and no function. Known are dataclasses, numpy arrays, tuples, lists,
mappings, `None`, bool, int, float, str, bytes, `Path`, `Literal`, unions of these, and `Any` for
JSON values. An answer is

    head    JSON: lists in the order of a class's fields, and of an array `[dtype, shape, order]`
    bytes   of every array and every `bytes`, one after another, each used once
"""

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from storage.array_hints import array_scalar

DTYPES: Mapping[str, np.dtype[Any]] = {
    name: np.dtype(name)
    for name in ("bool", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
                 "float16", "float32", "float64")
}  # fmt: skip
"""The arrays that there are."""

MOST_AXES = 16


class NotAsDeclared(Exception):
    """A value, or what stands for one, is not of the type that is declared: why, in words."""


class Bytes:
    """What stands behind the head, taken piece by piece in the order in which it was put."""

    def __init__(self, whole: memoryview) -> None:
        self._left = whole

    def take(self, count: object) -> memoryview:
        """Return the next bytes, not yet copied; NotAsDeclared where there are not so many."""
        _require(_is_count(count), "a number of bytes")
        assert isinstance(count, int)
        _require(count <= len(self._left), "bytes that are there")
        taken, self._left = self._left[:count], self._left[count:]
        return taken

    def require_end(self) -> None:
        """Raise NotAsDeclared where something is left."""
        _require(not self._left, "nothing behind the last value")


Put = Callable[[memoryview], None]
"""Takes bytes to stand behind the head."""


@dataclass(frozen=True)
class Form:
    """One type, both ways."""

    takes: Callable[[Any], bool]
    """Whether a value is of this type, by its outermost type."""
    pack: Callable[[Any, Put], Any]
    """Returns what stands in the head for a value that it takes."""
    unpack: Callable[[Any, Bytes], Any]
    """Returns the value of it; raises NotAsDeclared, or what a class's own checks raise."""


def pack(form: Form, value: Any, put: Put) -> Any:
    """Return what stands in the head for a value; NotAsDeclared where it is of another type."""
    if not form.takes(value):
        raise NotAsDeclared(f"a value of {type(value).__name__} stands where another type does")
    return form.pack(value, put)


@functools.cache
def form_of(hint: Any) -> Form:
    """Return the form of an annotation.

    Raises:
        TypeError: it says nothing that bytes could be checked against.
    """
    origin, args = get_origin(hint), get_args(hint)
    if hint in _SIMPLE:
        return _SIMPLE[hint]
    if origin is Literal:
        return Form(lambda value: value in args, _as_it_is, functools.partial(_one_of, args))
    if origin in (typing.Union, types.UnionType):
        return _union(args)
    if (scalar := array_scalar(hint)) is not None:
        return _array(scalar)
    if origin is tuple:
        return _row(tuple, args[0]) if args[-1] is Ellipsis else _fixed(args)
    if origin in (list, Sequence):
        return _row(list if origin is list else tuple, args[0])
    if origin in (dict, Mapping):
        return _mapping(*args)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _record(hint)
    raise TypeError(f"{hint} cannot be checked when it comes from a child; declare what it is.")


def _require(condition: bool, expected: str) -> None:
    if not condition:
        raise NotAsDeclared(f"expected {expected}")


def _is_count(value: object) -> bool:
    return type(value) is int and value >= 0


def _as_it_is(value: Any, put: Put) -> Any:
    return value


_PLAIN: Mapping[Any, tuple[type, ...]] = {
    None: (types.NoneType,),
    types.NoneType: (types.NoneType,),
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (float, int, np.floating, np.integer),
    str: (str,),
}
"""What a value of a plain type may be here, numpy's scalars among it."""


def _plain(hint: Any) -> Form:
    kinds = _PLAIN[hint]
    bare = tuple(kind for kind in kinds if not issubclass(kind, np.generic))

    def takes(value: Any) -> bool:
        return isinstance(value, kinds) and (bool in kinds or not isinstance(value, bool))

    def unpack(data: Any, rest: Bytes) -> Any:
        _require(type(data) in bare, bare[0].__name__)
        return data

    return Form(takes, _bare, unpack)


def _bare(value: Any, put: Put) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _unpack_bytes(data: Any, rest: Bytes) -> bytes:
    return bytes(rest.take(data))


def _pack_bytes(value: bytes, put: Put) -> int:
    put(memoryview(value))
    return len(value)


def _unpack_path(data: Any, rest: Bytes) -> Path:
    _require(type(data) is str and "\0" not in data, "a path")
    return Path(data)


def _pack_json(value: Any, put: Put) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _pack_json(each, put) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_pack_json(each, put) for each in value]
    if isinstance(value, None | bool | int | float | str | np.generic):
        return _bare(value, put)
    raise NotAsDeclared(f"{type(value).__name__} is no value of JSON")


_SIMPLE: Mapping[Any, Form] = {
    **{hint: _plain(hint) for hint in _PLAIN},
    bytes: Form(lambda value: isinstance(value, bytes), _pack_bytes, _unpack_bytes),
    Path: Form(lambda value: isinstance(value, Path), lambda value, put: str(value), _unpack_path),
    Any: Form(lambda value: True, _pack_json, lambda data, rest: data),
}


def _one_of(known: tuple[Any, ...], data: Any, rest: Bytes) -> Any:
    _require(any(type(data) is type(each) and data == each for each in known), f"one of {known}")
    return data


def _union(options: tuple[Any, ...]) -> Form:
    """Return the form of one of several types, whose number stands before the value's own."""
    may_be_none = types.NoneType in options
    forms = [form_of(option) for option in options if option is not types.NoneType]

    def takes(value: Any) -> bool:
        return (may_be_none and value is None) or any(form.takes(value) for form in forms)

    def pack(value: Any, put: Put) -> Any:
        if may_be_none and value is None:
            return None
        number = next(number for number, form in enumerate(forms) if form.takes(value))
        return [number, forms[number].pack(value, put)]

    def unpack(data: Any, rest: Bytes) -> Any:
        if may_be_none and data is None:
            return None
        number, inner = _listed(data, 2)
        _require(_is_count(number) and number < len(forms), "the number of a type")
        return forms[number].unpack(inner, rest)

    return Form(takes, pack, unpack)


def _array(scalar: Any) -> Form:
    """Return the form of arrays of one dtype, or of the dtypes of an abstract one."""
    wanted = scalar if isinstance(scalar, type) and issubclass(scalar, np.generic) else np.generic

    def takes(value: Any) -> bool:
        return (
            isinstance(value, np.ndarray)
            and value.dtype.name in DTYPES
            and np.issubdtype(value.dtype, wanted)
        )

    def pack(value: NDArray[Any], put: Put) -> Any:
        by_columns = value.flags.f_contiguous and not value.flags.c_contiguous
        rows = np.ascontiguousarray(value.T if by_columns else value, DTYPES[value.dtype.name])
        put(rows.reshape(-1).view(np.uint8).data)
        return [value.dtype.name, list(value.shape), "F" if by_columns else "C"]

    def unpack(data: Any, rest: Bytes) -> NDArray[Any]:
        name, shape, order = _listed(data, 3)
        _require(type(name) is str and name in DTYPES, "a known dtype")
        _require(np.issubdtype(DTYPES[name], wanted), f"an array of {wanted.__name__}")
        _require(type(shape) is list and len(shape) <= MOST_AXES, "a shape")
        _require(all(map(_is_count, shape)) and order in ("C", "F"), "a shape")
        piece = rest.take(math.prod(shape) * DTYPES[name].itemsize)
        plain = np.frombuffer(piece, np.uint8)
        flat = plain != 0 if name == "bool" else plain.copy().view(DTYPES[name])
        return flat.reshape(shape, order=order)

    return Form(takes, pack, unpack)


def _listed(data: Any, count: int | None = None) -> list[Any]:
    _require(type(data) is list, "a list")
    _require(count is None or len(data) == count, f"{count} entries")
    return typing.cast(list[Any], data)


def _row(made: type, hint: Any) -> Form:
    """Return the form of any number of values of one type."""
    form = form_of(hint)
    return Form(
        lambda value: isinstance(value, list | tuple),
        lambda value, put: [pack(form, each, put) for each in value],
        lambda data, rest: made([form.unpack(each, rest) for each in _listed(data)]),
    )


def _fixed(hints: tuple[Any, ...]) -> Form:
    """Return the form of a tuple of so many values, each of its own type."""
    forms = [form_of(hint) for hint in hints]
    count = len(forms)
    return Form(
        lambda value: isinstance(value, tuple) and len(value) == count,
        lambda value, put: [pack(*each, put) for each in zip(forms, value, strict=True)],
        lambda data, rest: tuple(
            form.unpack(each, rest) for form, each in zip(forms, _listed(data, count), strict=True)
        ),
    )


def _mapping(key: Any, held: Any) -> Form:
    pair = _fixed((key, held))
    return Form(
        lambda value: isinstance(value, Mapping),
        lambda value, put: [pack(pair, each, put) for each in value.items()],
        lambda data, rest: dict(pair.unpack(each, rest) for each in _listed(data)),
    )


def _record(kind: type) -> Form:
    """Return the form of a dataclass, which is made by calling it: its own checks are made."""
    hints = typing.get_type_hints(kind)
    names = [field.name for field in dataclasses.fields(kind) if field.init]
    row = _fixed(tuple(hints[name] for name in names))
    return Form(
        lambda value: type(value) is kind,
        lambda value, put: row.pack(tuple(getattr(value, name) for name in names), put),
        lambda data, rest: kind(**dict(zip(names, row.unpack(data, rest), strict=True))),
    )
