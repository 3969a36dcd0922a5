"""What a child answers to a call, and what its owner makes of that; no byte of it is run.

A result has the type that the called function declares. Errors are sentences, and their types come
from a list.
"""

import functools
import json
import re
import typing
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from pipeline.isolation.deaths import ENDS, ChildFailed
from pipeline.isolation.values import Bytes, Form, NotAsDeclared, form_of, pack
from storage.errors import EnvironmentFailure, Rejected, TrilightError

MOST_HEAD_BYTES = 16 << 20
"""Of an answer without its arrays."""
_LENGTH = 8

_MISTAKES: dict[str, type[TrilightError]] = {
    kind.__name__: kind for kind in (TrilightError, EnvironmentFailure)
}
_REASON = re.compile(r"[a-z][a-z0-9_]{0,63}")
_MOST_CHARACTERS = 20_000


@functools.cache
def declared_form(function: Callable[..., Any]) -> Form:
    """Return the form of what a function returns; nothing where it says nothing.

    Raises:
        TypeError: what it returns could not be checked.
    """
    said = hasattr(function, "__annotations__")  # builtins have none
    kind: Any = typing.get_type_hints(function).get("return") if said else None
    return form_of(None if kind is NoReturn else kind)


def encode_result(value: Any, function: Callable[..., Any]) -> list[bytes | memoryview]:
    """Return the parts of an answer; NotAsDeclared where the value is of another type."""
    behind: list[memoryview] = []
    head = _encode(["result", pack(declared_form(function), value, behind.append)])
    if len(head) > MOST_HEAD_BYTES:
        raise NotAsDeclared(f"{len(head)} bytes beside arrays; expected at most {MOST_HEAD_BYTES}")
    return [len(head).to_bytes(_LENGTH, "little"), head, *behind]


def encode_error(kind: str, *words: str) -> list[bytes | memoryview]:
    """Return the parts of an answer that is a failure: `rejected`, a mistake's class, or an end."""
    head = _encode([kind, *(word[:_MOST_CHARACTERS] for word in words)])
    return [len(head).to_bytes(_LENGTH, "little"), head]


def _encode(head: Any) -> bytes:
    return json.dumps(head, separators=(",", ":")).encode()


def decode_answer(message: memoryview, function: Callable[..., Any]) -> Any:
    """Return the result of a call.

    Args:
        message: any bytes.
        function: what was called.

    Raises:
        Rejected, TrilightError: as the function raised them.
        ChildFailed: it raised something else; or `nonsense`, where the bytes are no answer.
    """
    try:
        kind, words, data, rest = _opened(message)
        if kind == "result":
            value = declared_form(function).unpack(data, rest)
            rest.require_end()
            return value
    except Exception as error:  # checks of a class that is made raise what they like
        name = f"{function.__module__}.{getattr(function, '__qualname__', function)}"
        said = str(error) if isinstance(error, NotAsDeclared) else type(error).__name__
        raise ChildFailed(
            "nonsense", f"what came back from {name} is not what it returns ({_safe(said)})"
        ) from error
    raise _failure(kind, words)


def _opened(message: memoryview) -> tuple[str, list[str], Any, Bytes]:
    """Return kind, words of an error, data of a result, and the bytes behind the head."""
    whole = Bytes(message)
    length = int.from_bytes(whole.take(_LENGTH), "little")
    if length > MOST_HEAD_BYTES:
        raise NotAsDeclared(f"a head of {length} bytes; expected at most {MOST_HEAD_BYTES}")
    match json.loads(bytes(whole.take(length))):
        case ["result", data]:
            return "result", [], data, whole
        case ["rejected", str(reason), str(said)] if _REASON.fullmatch(reason):
            return "rejected", [reason, _safe(said)], None, whole
        case [str(kind), str(said)] if kind in _MISTAKES or kind in _FAILURES:
            return kind, [_safe(said)], None, whole
    raise NotAsDeclared("expected a result or an error that is known")


_FAILURES = ("out_of_memory", "exception")
assert set(_FAILURES) <= set(ENDS)


def _failure(kind: str, words: Iterable[str]) -> Exception:
    if kind == "rejected":
        return Rejected(*words)
    if kind in _MISTAKES:
        return _MISTAKES[kind](*words)
    return ChildFailed(kind, *words)


def _safe(text: str) -> str:
    """Return a sentence that is shown to people without what would command a terminal."""
    shown = text[:_MOST_CHARACTERS]
    return "".join(sign if sign.isprintable() or sign == "\n" else "\ufffd" for sign in shown)
