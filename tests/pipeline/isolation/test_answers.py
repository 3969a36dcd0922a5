"""Whatever bytes a child sends, its owner gets what was declared, or a sentence.

Values cross without pickle: they come back as they were, and as nothing but what is declared.
"""

import dataclasses
import json
import os
import pickle  # noqa: TID251 - what an attacker would send
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, frames
from pipeline.isolation.answers import (
    MOST_HEAD_BYTES,
    declared_form,
    decode_answer,
    encode_error,
    encode_result,
)
from pipeline.isolation.values import DTYPES, Bytes, NotAsDeclared, form_of, pack
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


@dataclass(frozen=True, kw_only=True)
class Inner:
    count: int
    share: float | None
    kind: Literal["one", "other"] = "one"


@dataclass(frozen=True, kw_only=True)
class Wider(Inner):
    more: str = ""


@dataclass(frozen=True, kw_only=True)
class Outer:
    inners: tuple[Inner, ...]
    pictures: Mapping[str, NDArray[np.float32]]
    packed: bytes
    path: Path
    facts: Mapping[str, Any]
    last: Inner | Wider | None

    def __post_init__(self) -> None:
        if len(self.inners) > 5:
            raise ValueError("too many")


def crossed(value: Any, hint: Any) -> Any:
    """Return what a value is on the other side."""
    behind: list[memoryview] = []
    head = json.loads(json.dumps(pack(form_of(hint), value, behind.append)))
    rest = Bytes(memoryview(b"".join(behind)))
    found = form_of(hint).unpack(head, rest)
    rest.require_end()
    return found


ARRAYS = hnp.arrays(st.sampled_from(sorted(DTYPES)), hnp.array_shapes(min_dims=0, min_side=0))


@given(ARRAYS, st.booleans())
def test_an_array_keeps_every_bit_its_dtype_shape_and_order(
    array: NDArray[Any], turned: bool
) -> None:
    array = array.T if turned else array
    found = crossed(array, NDArray[Any])
    assert (found.dtype, found.shape) == (array.dtype, array.shape)
    assert found.flags.f_contiguous == array.flags.f_contiguous
    assert found.flags.writeable and found.tobytes() == array.tobytes()


INNERS = st.builds(Inner, count=st.integers(), share=st.none() | st.floats(allow_nan=False))
PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()


@settings(max_examples=50)
@given(
    st.tuples(INNERS, INNERS),
    st.binary(),
    st.dictionaries(st.text(), st.recursive(PLAIN, st.lists, max_leaves=9)),
    st.none() | INNERS | st.just(Wider(count=1, share=0.5, more="x")),
)
def test_a_record_comes_back_as_it_was(
    inners: tuple[Inner, ...], packed: bytes, facts: dict[str, Any], last: Inner | None
) -> None:
    picture = np.arange(6, dtype=np.float32).reshape(1, 2, 3)
    sent = Outer(
        inners=inners,
        pictures={"a": picture},
        packed=packed,
        path=Path("a/b"),
        facts=facts,
        last=last,
    )
    found = crossed(sent, Outer)
    assert type(found.last) is type(last)
    assert np.array_equal(found.pictures["a"], picture)
    assert dataclasses.replace(found, pictures=sent.pictures) == sent


def test_numbers_of_numpy_become_pythons_and_keep_their_value() -> None:
    found = crossed((np.float32(0.1), np.int64(3), np.bool_(True)), tuple[float, int, bool])
    assert found == (float(np.float32(0.1)), 3, True)
    assert [type(each) for each in found] == [float, int, bool]


@for_each(
    ("value", "hint"),
    [
        (True, int),
        (1.5, int),
        ("1", float),
        (b"text", str),
        (np.zeros(3), NDArray[np.float32]),
        (np.zeros(1, object), NDArray[Any]),
        (Wider(count=1, share=None), Inner),
        ([1, "2"], list[int]),
        ((1, 2, 3), tuple[int, int]),
        ({1: 2}, Mapping[str, int]),
        ("third", Literal["one", "other"]),
        ({"a": object()}, Mapping[str, Any]),
    ],
)
def test_a_value_of_another_type_is_not_sent(value: Any, hint: Any) -> None:
    with pytest.raises(NotAsDeclared):
        crossed(value, hint)


@for_each("hint", [object, set[int], Callable[[], int], type, np.ndarray])
def test_a_type_that_could_not_be_checked_is_refused(hint: Any) -> None:
    with pytest.raises(TypeError, match="declare what it is"):
        form_of(hint)


@for_each(
    ("data", "hint"),
    [
        (["object", [1], "C"], NDArray[Any]),
        (["float64", [1], "C"], NDArray[np.float32]),
        (["float32", [3], "C"], NDArray[np.float32]),  # 12 of 8 bytes
        (["float32", [-1], "C"], NDArray[np.float32]),
        (["float32", [1 << 40, 1 << 40], "C"], NDArray[np.float32]),
        (["float32", [1], "A"], NDArray[np.float32]),
        (9, bytes),
        (-1, bytes),
        (True, bytes),
        ("a\0b", Path),
        ([7, 1], int | str),
        ([True, "x"], int | str),
        ([[1]], Sequence[tuple[int, int]]),
        ([1, None], Inner),
        ([1.0, None, "one"], Inner),
        (1, Literal[True]),
    ],
)
def test_what_is_not_as_declared_is_refused(data: Any, hint: Any) -> None:
    with pytest.raises(NotAsDeclared):
        form_of(hint).unpack(data, Bytes(memoryview(bytes(8))))


def test_no_bytes_are_used_twice_truth_values_are_such_and_checks_of_a_class_are_made() -> None:
    """So that a short answer cannot fill the memory of who reads it."""
    rest = Bytes(memoryview(bytes(8)))
    form = form_of(tuple[bytes, bytes])
    assert form.unpack([8, 0], rest) == (bytes(8), b"")
    with pytest.raises(NotAsDeclared, match="bytes that are there"):
        form.unpack([8, 8], Bytes(memoryview(bytes(8))))
    found = form_of(NDArray[np.bool_]).unpack(["bool", [3], "C"], Bytes(memoryview(b"\0\1\7")))
    assert found.tobytes() == b"\0\1\1"
    data = pack(form_of(Inner), Inner(count=1, share=None), lambda piece: None)
    held = [[data] * 6, [], 0, "a", [], None]
    with pytest.raises(ValueError, match="too many"):
        form_of(Outer).unpack(held, Bytes(memoryview(b"")))
