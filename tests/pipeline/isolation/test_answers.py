"""Whatever bytes a child sends, its owner gets what was declared, or a sentence."""

import ast
import importlib
import json
import os
import pickle  # noqa: TID251 - what an attacker would send
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, frames
from pipeline.isolation.answers import (
    MOST_HEAD_BYTES,
    declared_form,
    decode_answer,
    encode_error,
    encode_result,
)
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.installation import module_name
from tests.conftest import ROOT
from tests.for_each import for_each
from tests.pipeline.isolation.called import (
    anything,
    deaf,
    double,
    large,
    length_of,
    lie,
    nothing,
    taken_over,
)

LIMITS = ChildLimits(memory_bytes=2 << 30, wall_s=1.5, calls_per_child=100)


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    name: str
    count: int
    picture: NDArray[np.float32]
    parts: Mapping[str, bytes]
    notes: tuple[str, ...] | None


def find() -> Found:
    picture = np.ones((2, 3), np.float32)
    return Found(name="a", count=7, picture=picture, parts={"b": b"cd"}, notes=("e",))


RIGHT = b"".join(encode_result(find(), find))


def _is_declared(found: object) -> bool:
    return (
        type(found) is Found
        and type(found.name) is str
        and type(found.count) is int
        and type(found.picture) is np.ndarray
        and found.picture.dtype == np.float32
        and all(type(key) is str and type(data) is bytes for key, data in found.parts.items())
        and (found.notes is None or all(type(note) is str for note in found.notes))
    )


def _with_head(head: object, behind: bytes = b"") -> bytes:
    text = json.dumps(head).encode()
    return len(text).to_bytes(8, "little") + text + behind


def _changed(at: int, byte: int, cut: int | None) -> bytes:
    damaged = bytearray(RIGHT)
    damaged[at % len(RIGHT)] = byte
    return bytes(damaged[:cut])


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=20,
)
_KINDS = ("result", "rejected", "TrilightError", "EnvironmentFailure", "exception", "KeyError")
_ANY = (
    st.binary(max_size=200)
    | st.builds(_changed, st.integers(0, 500), st.integers(0, 255), st.none() | st.integers(0, 200))
    | st.builds(_with_head, _JSON, st.binary(max_size=40))
    | st.builds(
        lambda kind, rest, behind: _with_head([kind, *rest], behind),
        st.sampled_from(_KINDS),
        st.lists(_JSON, max_size=3),
        st.binary(max_size=40),
    )
)


@settings(max_examples=200, deadline=None)
@given(_ANY)
@example(RIGHT)
@example(RIGHT + b"x")
@example(_with_head("[" * 100_000))
@example(b"\x20\0\0\0\0\0\0\0" + b"[" * 32)
def test_any_bytes_are_what_was_declared_or_a_sentence(sent: bytes) -> None:
    try:
        found = decode_answer(memoryview(sent), find)
    except (Rejected, TrilightError) as error:
        assert str(error).isprintable() or "\n" in str(error)
    except ChildFailed as failure:
        if failure.reason == "nonsense":
            assert f"{__name__}.find" in failure.message
        else:
            assert failure.reason in ("exception", "out_of_memory")
    else:
        assert _is_declared(found)


def test_brackets_without_end_are_nonsense() -> None:
    text = b'["result",' + b"[" * 200_000
    with pytest.raises(ChildFailed, match="nonsense: .*RecursionError"):
        decode_answer(memoryview(len(text).to_bytes(8, "little") + text), find)


def test_a_long_head_is_not_even_read() -> None:
    sent = (MOST_HEAD_BYTES + 1).to_bytes(8, "little") + bytes(MOST_HEAD_BYTES + 1)
    with pytest.raises(ChildFailed, match="a head of"):
        decode_answer(memoryview(sent), find)


@for_each(
    ("error", "kind"),
    [
        (("rejected", "no_faces", "nothing\x1b[2Jthere"), Rejected),
        (("TrilightError", "x: is\x07 wrong."), TrilightError),
        (("EnvironmentFailure", "the disk is full."), EnvironmentFailure),
    ],
)
def test_errors_are_sentences_of_known_types(error: tuple[str, ...], kind: type) -> None:
    with pytest.raises(kind) as caught:
        decode_answer(memoryview(b"".join(encode_error(*error))), find)
    assert type(caught.value) is kind
    assert str(caught.value).isprintable()


class Hostile:
    """What, unpickled, makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[[Path], None], tuple[Path]]:
        return Path.touch, (self.path,)


@pytest.fixture
def child() -> Iterator[IsolatedChild]:
    child = IsolatedChild(limits=LIMITS, setup=nothing)
    yield child
    child.close()


@for_each("form", ["frame", "connection", "inner"])
def test_a_hostile_pickle_makes_no_file(child: IsolatedChild, tmp_path: Path, form: str) -> None:
    code = pickle.dumps(Hostile(tmp_path / "made"))
    sent = {
        "frame": len(code).to_bytes(8, "little") + code,
        "connection": len(code).to_bytes(4, "big") + code,  # as multiprocessing has it
        "inner": b"".join((len(inner := _with_head(["result", len(code)], code))
                           .to_bytes(8, "little"), inner)),
    }[form]  # fmt: skip
    with pytest.raises(ChildFailed, match=r"nonsense|timeout_wall"):
        child.call(taken_over, [sent], 0.0)
    assert not (tmp_path / "made").exists()
    assert child.call(double, 4) == 8
    pickle.loads(code)
    assert (tmp_path / "made").exists(), "the bytes are hostile indeed"


def test_an_answer_that_never_ends_does() -> None:
    """Neither its length nor its pieces, each of which comes in time, hold its owner."""
    limits = ChildLimits(memory_bytes=2 << 30, wall_s=1, calls_per_child=100)
    endless, trickle = (1 << 60).to_bytes(8, "little"), (200).to_bytes(8, "little")
    began_s = time.monotonic()
    with closing(IsolatedChild(limits=limits, setup=nothing)) as child:
        with pytest.raises(ChildFailed, match="nonsense: its answer would have"):
            child.call(taken_over, [endless], 0.0)
        with pytest.raises(ChildFailed, match="timeout_wall"):
            child.call(taken_over, [trickle, *([b"x"] * 199)], 0.1)
    assert time.monotonic() - began_s < 15  # a busy machine starts a child in that


def test_a_child_that_reads_no_more_is_given_up(child: IsolatedChild) -> None:
    child.call(deaf, b"".join(encode_result(1, deaf)))
    with pytest.raises(ChildFailed, match="timeout_wall"):
        child.call(length_of, bytes(8 << 20))


def test_who_returns_what_it_does_not_declare_is_told(child: IsolatedChild) -> None:
    with pytest.raises(ChildFailed, match="exception: .*NotAsDeclared: a value of str"):
        child.call(lie)


def test_a_function_whose_answer_cannot_be_checked_is_not_called(child: IsolatedChild) -> None:
    with pytest.raises(TypeError, match="declare what it is"):
        child.call(anything)


def test_large_values_come_whole(child: IsolatedChild) -> None:
    assert child.call(large) == large()


def test_a_builtin_returns_nothing() -> None:
    assert declared_form(os._exit).unpack(None, Any) is None  # type: ignore[arg-type]
    assert frames._LENGTH == 8


_CALLS = {"call_with_retries": 1, "_call": 1, "call": 0}
"""Who calls in a child, and which of its arguments is the function."""


def _called() -> Iterator[tuple[str, str]]:
    """Yield (module, function) of what is handed to such a call by its name."""
    for package in ("pipeline", "infra"):
        for path in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            for node in ast.walk(ast.parse(path.read_text())):
                name = _function_of(node)
                if name:
                    yield module, name


def _function_of(node: ast.AST) -> str | None:
    if not isinstance(node, ast.Call):
        return None
    called = node.func
    name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
    if name not in _CALLS or len(node.args) <= _CALLS[name]:
        return None
    given = node.args[_CALLS[name]]
    if isinstance(given, ast.Attribute) and isinstance(given.value, ast.Name):
        return f"{given.value.id}.{given.attr}"
    return given.id if isinstance(given, ast.Name) else None


def _found(module: str, name: str) -> object:
    found: object = importlib.import_module(module_name(module))
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def test_what_is_called_in_children_can_be_checked() -> None:
    pytest.importorskip("torch", reason="some of it needs torch")
    functions = {each: _found(*each) for each in _called()}
    known = {each: found for each, found in functions.items() if callable(found)}
    assert len(known) > 20, "the walk finds them"
    wrong = {}
    for each, function in known.items():
        try:
            declared_form(function)
        except TypeError as error:
            wrong[each] = str(error)
    assert not wrong
