"""Whatever bytes a child sends, its owner gets what was declared, or a sentence."""

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


def test_heads_without_end_are_nonsense_and_long_ones_not_even_read() -> None:
    text = b'["result",' + b"[" * 200_000
    with pytest.raises(ChildFailed, match="nonsense: .*RecursionError"):
        decode_answer(memoryview(len(text).to_bytes(8, "little") + text), find)
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


def test_values_come_whole_and_only_as_their_function_declares_them(child: IsolatedChild) -> None:
    with pytest.raises(ChildFailed, match="exception: .*NotAsDeclared: a value of str"):
        child.call(lie)
    with pytest.raises(TypeError, match="declare what it is"):
        child.call(anything)
    assert child.call(large) == large()


def test_a_builtin_returns_nothing() -> None:
    assert declared_form(os._exit).unpack(None, Any) is None  # type: ignore[arg-type]
    assert frames._LENGTH == 8
