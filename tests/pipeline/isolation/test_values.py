"""Values cross without pickle: they come back as they were, and as nothing but what is declared."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from pipeline.isolation.values import DTYPES, Bytes, NotAsDeclared, form_of, pack
from tests.for_each import for_each


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
