"""Serializes a child's answer to a call, and reads it in the owner; no byte of it is executed.

Errors are sentences, and their types come from a list. The parts of an answer are

    words   JSON: `["result"]`, or the kind of an error and its sentences
    value   JSON: a dataclass by its fields, an array as `[number, dtype, shape, order]`
    bytes   of each array, path and `bytes`, whose number from 0 stands in the value
"""

import dataclasses
import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.isolation.call_failures import ENDS, ChildFailed
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.remote.safe_url import escape_lines

CLASS = ""
"""Key of a dataclass's name among its fields: two classes of a union may have the same fields."""
MOST_HEAD_BYTES = 16 << 20
"""Most bytes of the part `words` of an answer, and of the part `value`."""
_MISTAKES = {kind.__name__: kind for kind in (TrilightError, EnvironmentFailure)}
_FAILURES = ("out_of_memory", "exception")
assert set(_FAILURES) <= set(ENDS)
_REASON = re.compile(r"[a-z][a-z0-9_]{0,63}")
_MOST_CHARACTERS = 20_000


def encode_result(value: Any) -> list[bytes | memoryview]:
    """Return the parts of an answer; raises TypeError for a value of an unknown type."""
    parts: list[bytes | memoryview] = []

    def append_part(part: bytes | memoryview) -> int:
        parts.append(part)
        return len(parts) - 1

    def to_plain(item: Any) -> Any:
        if isinstance(item, np.generic):
            return item.item()
        if isinstance(item, np.ndarray):
            name = item.dtype.name
            order = "F" if item.flags.fnc else "C"
            rows = np.ascontiguousarray(item.T if item.flags.fnc else item, name)
            return [append_part(rows.reshape(-1).view(np.uint8).data), name, item.shape, order]
        if isinstance(item, bytes | Path):
            return append_part(os.fsencode(item))
        if isinstance(item, Mapping):
            return dict(item)
        names = [field.name for field in dataclasses.fields(item) if field.init]
        return {CLASS: type(item).__name__} | {name: getattr(item, name) for name in names}

    head = json.dumps(value, default=to_plain, ensure_ascii=False, separators=(",", ":"))
    return [b'["result"]', head.encode(errors="replace"), *parts]


def encode_error(kind: str, *words: str) -> list[bytes | memoryview]:
    """Return the parts of an error: `rejected`, the class of a mistake, or a reason of `ENDS`."""
    return [json.dumps([kind, *(word[:_MOST_CHARACTERS] for word in words)]).encode()]


def decode_answer(parts: list[NDArray[np.uint8]], function: Callable[..., Any]) -> Any:
    """Return the result of a call.

    Args:
        parts: untrusted bytes; the result's arrays share their memory.
        function: the function that was called.

    Raises:
        Rejected, TrilightError: as the function raised them.
        ChildFailed: the function raised another error; or `nonsense`, if the bytes are no answer.
        MemoryError: this process has no memory for it.
    """
    from pipeline.isolation.result_schema import first_wrong, result_reader  # children do without

    try:
        heads = [part.tobytes() for part in parts[:2] if len(part) <= MOST_HEAD_BYTES]
        match json.loads(heads[0]):
            case ["result"]:
                return result_reader(function).validate_json(heads[1], context=parts[2:])
            case ["rejected", str(reason), str(said)] if _REASON.fullmatch(reason):
                failure: Exception = Rejected(reason, make_printable(said))
            case [str(kind), str(said)] if kind in _MISTAKES:
                failure = _MISTAKES[kind](make_printable(said))
            case [str(kind), str(said)] if kind in _FAILURES:
                failure = ChildFailed(kind, make_printable(said))
            case _:
                raise ValueError("expected a result or an error that is known")
    except MemoryError:
        raise
    except Exception as error:  # the checks of a dataclass may raise any error
        name = f"{function.__module__}.{getattr(function, '__qualname__', function)}"
        wrong = f"what came back from {name} is not what it returns ({first_wrong(error)})"
        raise ChildFailed("nonsense", make_printable(wrong)) from error
    raise failure


def make_printable(text: str) -> str:
    """Return the beginning of a text, with control characters escaped."""
    return escape_lines(text[:_MOST_CHARACTERS])
