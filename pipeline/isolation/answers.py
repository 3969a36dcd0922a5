"""Serializes a child's answer to a call, and reads it in the owner; no byte of it is executed.

Errors are sentences, and their types come from a list. The parts of an answer are

    words   JSON: `["result"]`, or the kind of an error and its sentences
    value   JSON: a dataclass by its fields, an array as `[number, dtype, shape, order]`
    bytes   of each array, path and `bytes`, whose number from 0 stands in the value

A message is sent as parts, after their number and lengths. The owner waits for each piece within
the time limit of one call, so that a child that sends half a message, or reads none, blocks it no
longer than a silent one. Time is counted in polls, not by a clock, and a stopped process does not
poll. So Ctrl-Z, which stops a command and all its children together, and a sleeping laptop take
none of a child's time.
"""

import dataclasses
import json
import logging
import os
import re
import select
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.isolation.call_failures import ENDS, ChildFailed
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.remote.url import escape_lines

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


log = logging.getLogger("trilight.children")

LOOK_S = 1.0
"""Pause between two polls of a child that has not answered."""
LOOKS_BEFORE_WORDS = 3
"""Polls that find a child stopped before a warning is logged. A single one may see a child that is
about to continue together with this process."""
LOOKS_BEFORE_KILL = 60
"""Polls that may find a child stopped before it is given up: time to continue it by hand."""


_LENGTH = np.dtype("<u8")
MOST_PARTS = 1 << 17

Wait = Callable[[int, int], None] | None
"""Waits until a file can be read or written: takes its number and an event of `select.poll`. None
is for a blocking file, whose reads and writes wait by themselves."""


class CallTime:
    """A `Wait` for files that do not block, within one time limit of a call to a child."""

    def __init__(self, process_id: int, wall_s: float) -> None:
        self._process_id = process_id
        self._wall_s = wall_s
        self._waited_s = 0.0
        self._stopped = 0

    def __call__(self, file: int, event: int) -> None:
        """Wait until an event happens.

        Raises:
            ChildFailed: `timeout_wall`, or `stopped` where the child was stopped and not continued.
        """
        poll = select.poll()
        poll.register(file, event)
        while self._waited_s < self._wall_s:
            pause_s = min(LOOK_S, self._wall_s - self._waited_s)
            began_s = time.monotonic()
            if poll.poll(pause_s * 1000):  # many short waits count too
                self._waited_s += min(pause_s, time.monotonic() - began_s)
                return
            self._waited_s += pause_s
            self._check_stopped()
        raise ChildFailed("timeout_wall", f"no answer within {self._wall_s:.0f} s")

    def _check_stopped(self) -> None:
        self._stopped = self._stopped + 1 if _is_stopped(self._process_id) else 0
        if self._stopped == LOOKS_BEFORE_WORDS:
            log.warning(
                "child process %d has been stopped from outside. Continue it with `kill -CONT %d`; "
                "otherwise it is ended in %.0f s and its work is done again.",
                self._process_id,
                self._process_id,
                (LOOKS_BEFORE_KILL - self._stopped) * LOOK_S,
            )
        if self._stopped == LOOKS_BEFORE_KILL:
            waited = f"{LOOKS_BEFORE_KILL * LOOK_S:.0f} s"
            raise ChildFailed("stopped", f"stopped from outside (SIGSTOP) for {waited}")


def _is_stopped(process_id: int) -> bool:
    """Return whether a process is stopped until it is continued; False without /proc."""
    try:
        line = Path(f"/proc/{process_id}/stat").read_text()
    except OSError:
        return False
    return line.rpartition(")")[2].split()[0] == "T"


def send(file: int, parts: Sequence[bytes | memoryview], wait: Wait = None) -> None:
    """Write one message; raises OSError if the other side has ended."""
    table = np.array([len(parts), *map(len, parts)], _LENGTH).tobytes()
    for part in (table, *parts):
        view = memoryview(part)
        while view:
            if wait:
                wait(file, select.POLLOUT)
            view = view[os.write(file, view) :]


def receive(file: int, most: int, wait: Wait = None) -> list[NDArray[np.uint8]]:
    """Return the parts of one message, each in memory of its own.

    Args:
        most: most bytes of all parts together.

    Raises:
        EOFError: the other side has ended.
        ChildFailed: `nonsense`, if the message claims more bytes, or more parts than `MOST_PARTS`.
        MemoryError: this process has no memory for it.
    """
    (count,) = _receive_bytes(file, _LENGTH.itemsize, wait).view(_LENGTH).tolist()
    if count > MOST_PARTS:
        said = f"{count} parts; expected at most {MOST_PARTS}"
        raise ChildFailed("nonsense", f"its answer would have {said}")
    lengths = _receive_bytes(file, count * _LENGTH.itemsize, wait).view(_LENGTH).tolist()
    if sum(lengths) > most:
        said = f"{sum(lengths)} bytes; expected at most {most}"
        raise ChildFailed("nonsense", f"its answer would have {said}")
    return [_receive_bytes(file, length, wait) for length in lengths]


def _receive_bytes(file: int, count: int, wait: Wait) -> NDArray[np.uint8]:
    data = np.zeros(count, np.uint8)  # lazy: memory is used only as it is filled
    rest = data.data
    while rest:
        if wait:
            wait(file, select.POLLIN)
        read = os.readv(file, [rest])
        if not read:
            raise EOFError
        rest = rest[read:]
    return data
