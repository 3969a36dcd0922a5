"""Errors of unlawful scenes: the field, its value, the expected value, the index."""

from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError


def require_law(law: NDArray[np.bool_], name: str, values: NDArray, expected: str) -> None:
    """Raise TrilightError for the first index at which `law` is false."""
    if law.all():
        return
    index = tuple(int(i) for i in np.argwhere(~law)[0])
    value = " ".join(np.array2string(values[index], threshold=16).split())
    broken_law(f"{name}{list(index)} is {value}", expected)


def require_array(array: NDArray, name: str, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Raise TrilightError unless an array has this type and shape, None being any length."""
    if array.dtype != dtype:
        broken_law(f"{name} has dtype {array.dtype}", f"{np.dtype(dtype)}")
    if array.ndim != len(shape) or any(
        expected not in (None, got) for expected, got in zip(shape, array.shape, strict=True)
    ):
        none = " with None for any length" if None in shape else ""
        broken_law(f"{name} has shape {array.shape}", f"{shape}{none}")


def broken_law(observed: str, expected: str) -> NoReturn:
    """Raise TrilightError for what was found."""
    raise TrilightError(f"scene: {observed}; expected {expected}.")


def wrong_value(name: str, got: Any, expected: str) -> NoReturn:
    """Raise TrilightError for a value from outside, of which the message shows the beginning."""
    broken_law(f"{name} is {got!r:.80}", expected)


_KINDS: Mapping[type, str] = {str: "text", bool: "true or false", list: "a list"}


def require_fields(value: Any, name: str, fields: Mapping[str, type]) -> None:
    """Raise TrilightError unless a JSON value has exactly these fields, of these types."""
    if not isinstance(value, Mapping) or value.keys() != fields.keys():
        wrong_value(name, value, f"exactly the fields {', '.join(sorted(fields))}")
    for field, kind in fields.items():
        if type(value[field]) is not kind:
            wrong_value(f"{name}.{field}", value[field], _KINDS[kind])
