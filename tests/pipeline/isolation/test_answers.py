"""Whatever bytes a child sends, its owner gets what was declared, or a sentence."""

import ast
import contextlib
import dataclasses
import importlib
import inspect
import json
import operator
import os
import pickle  # noqa: TID251 - what an attacker would send
import time
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path, PosixPath
from typing import Any, Literal, get_args, get_origin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from pipeline.exchange.convert import convert_sources
from pipeline.exchange.formats import SceneSource
from pipeline.exchange.reader import load_cameras, load_source, source_keys
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild, answers
from pipeline.isolation.answers import (
    CLASS,
    MOST_HEAD_BYTES,
    decode_answer,
    encode_error,
    encode_result,
)
from pipeline.isolation.result_schema import DTYPES, result_reader
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.installation import module_name
from storage.settings.fields import array_scalar
from tests.conftest import ROOT
from tests.for_each import case, for_each
from tests.pipeline.isolation import called
from tests.scenes_by_hand import tiny_scene
from trilight import write_scene

LIMITS = ChildLimits(memory_bytes=1 << 30, wall_s=60, calls_per_child=100)


def declaring(hint: Any) -> Callable[[], None]:
    def returns() -> None: ...

    returns.__annotations__ = {"return": hint}
    return returns


def read(parts: Sequence[bytes | memoryview], hint: Any) -> Any:
    return decode_answer([np.frombuffer(part, np.uint8).copy() for part in parts], declaring(hint))


def read_value(value: object, hint: Any, *parts: bytes) -> Any:
    return read([b'["result"]', json.dumps(value).encode(), *parts], hint)


def frame(*parts: bytes | memoryview) -> bytes:
    table = np.array([len(parts), *map(len, parts)], "<u8")
    return b"".join((table.tobytes(), *parts))


@dataclass(frozen=True, kw_only=True)
class Inner:
    count: int
    share: float | None
    kind: Literal["one", "other"] = "one"

    def __post_init__(self) -> None:
        if self.count > 5:
            raise ValueError("too many")


@dataclass(frozen=True, kw_only=True)
class Twin(Inner):
    """Has the same fields, and is another class."""


SHAPES = hnp.array_shapes(min_dims=0, min_side=0)
TYPED: Mapping[Any, st.SearchStrategy[Any]] = {
    types.NoneType: st.none(),
    bool: st.booleans(),
    int: st.integers(),
    float: st.floats(allow_nan=False) | st.integers(),
    str: st.text(),
    bytes: st.binary(),
    Path: st.builds(Path, st.text(st.characters(exclude_characters="\0", codec="utf-8"))),
    Literal["a", "b"]: st.sampled_from(["a", "b"]),
    Inner: st.builds(Inner, count=st.integers(max_value=5), share=st.none() | st.just(0.5)),
    Inner | Twin | None: st.builds(Twin, count=st.just(1), share=st.just(0.5)) | st.none(),
} | {
    NDArray[np.dtype(name).type]: st.one_of(  # type: ignore[misc]
        arrays := hnp.arrays(name, SHAPES), arrays.map(np.transpose)
    )
    for name in DTYPES
}


@st.composite
def typed_values(draw: st.DrawFn, depth: int = 3) -> tuple[Any, Any]:
    """Return a type and a value of it."""
    kind = draw(st.sampled_from(["plain", "tuple", "list", "row", "mapping", "record"]))
    if not depth or kind == "plain":
        hint = draw(st.sampled_from(list(TYPED)))
        return hint, draw(TYPED[hint])
    (hint, value), (other, more) = draw(typed_values(depth - 1)), draw(typed_values(depth - 1))
    if kind == "record":
        made = dataclasses.make_dataclass("Made", [("first", hint), ("second", other)], eq=False)
        return made, made(value, more)
    kinds: Mapping[str, tuple[Any, Any, Any]] = {
        "tuple": (tuple, (hint, other), (value, more)),
        "list": (list, (hint,), [value] * 2),
        "row": (tuple, (hint, ...), (value,)),
        "mapping": (Mapping, (str, hint), {"a": value}),
    }
    origin, args, held = kinds[kind]
    return types.GenericAlias(origin, args), held


def is_of(value: Any, hint: Any) -> bool:
    origin, args = get_origin(hint), get_args(hint)
    if origin is types.UnionType:
        return any(is_of(value, each) for each in args)
    if origin is Literal:
        return value in args
    if (scalar := array_scalar(hint)) is not None:
        return type(value) is np.ndarray and value.dtype == scalar
    if origin in (tuple, list):
        hints = args if origin is tuple and args[-1] is not ... else [args[0]] * len(value)
        return type(value) is origin and all(map(is_of, value, hints))
    if origin is not None:
        return all(type(name) is str and is_of(each, args[1]) for name, each in value.items())
    if dataclasses.is_dataclass(hint):
        fields = dataclasses.fields(hint)
        return type(value) is hint and all(is_of(getattr(value, f.name), f.type) for f in fields)
    return type(value) is hint or (hint, type(value)) in ((float, int), (Path, PosixPath))


@settings(max_examples=150, deadline=None)
@given(typed_values(), st.data())
def test_values_come_back_as_they_were_and_damaged_ones_as_declared_or_a_sentence(
    pair: tuple[Any, Any], data: st.DataObject
) -> None:
    hint, value = pair
    sent = encode_result(value)
    assert encode_result(read(sent, hint)) == sent
    assert is_of(read(sent, hint), hint)
    wrong = [*map(bytes, sent)]
    at = data.draw(st.integers(1, len(wrong) - 1))
    cut, rest = (data.draw(st.integers(0, len(wrong[at]))) for _ in range(2))
    other = encode_result(data.draw(typed_values(1))[1])[1]
    noise = data.draw(st.binary(max_size=3) | st.just(other))
    wrong[at] = wrong[at][:cut] + noise + wrong[at][rest:]
    try:
        assert is_of(read(wrong, hint), hint)
    except ChildFailed as failure:
        assert failure.reason == "nonsense"
        assert f"{__name__}.declaring" in failure.message
        assert failure.message.isprintable() or "\n" in failure.message


F32 = NDArray[np.float32]


def test_what_is_not_as_declared_is_refused_with_its_place() -> None:
    rows: list[tuple[Any, Any, str]] = [
        (True, int, "valid integer"),
        (1.0, int, "valid integer"),
        ("1", float, "valid"),
        ([1, "2"], list[int], r"\(1: .*valid integer"),
        ([1], tuple[int, int], "1: Field required"),
        ({"a": {CLASS: "Inner", "count": 1}}, Mapping[str, Inner], "a.share: Field required"),
        ({CLASS: "Twin", "count": 1, "share": None, "kind": "one"}, Inner, "'Inner'"),
        ({CLASS: "Inner", "count": 6, "share": None, "kind": "one"}, Inner, "too many"),
        ([0, "object", [1], "C"], NDArray[Any], "1: .*'float64'"),
        ([0, "float64", [1], "C"], F32, "1: .*'float32'"),
        ([0, "float32", [3], "C"], F32, "reshape"),
        ([0, "float32", [-1], "C"], F32, "2.0: .*greater"),
        ([0, "float32", [1 << 40, 1 << 40], "C"], F32, ""),
        ([0, "float32", [2], "A"], F32, "3: .*'C'"),
        ([-1, "float32", [2], "C"], F32, "0: .*greater"),
        ([9, "float32", [2], "C"], F32, "IndexError"),
        (9, bytes, "IndexError"),
    ]
    for value, hint, said in rows:
        refusal = f"nonsense: .*declaring.*{said}"
        with case((value, hint)), pytest.raises(ChildFailed, match=refusal):
            read_value(value, hint, bytes(8))


@for_each(
    "head", [b"[" * 200_000, b"1" * 100_000, b"", b"\xff", b"{", b" " * (MOST_HEAD_BYTES + 1)]
)
def test_heads_without_end_are_nonsense(head: bytes) -> None:
    for parts in ([], [head], [b'["result"]', head]):
        began_s = time.process_time()
        with pytest.raises(ChildFailed, match="nonsense"):
            read(parts, Mapping[str, Any])
        assert time.process_time() - began_s < 1


def test_bytes_that_many_values_name_cost_their_memory_once() -> None:
    """So that a short answer cannot fill the memory of who reads it."""
    held = read_value([0] * 1000, list[bytes], bytes(8))
    assert {id(each) for each in held} == {id(held[0])} and held[0] == bytes(8)
    same = read_value([[0, "bool", [3], "C"]] * 1000, list[NDArray[np.bool_]], b"\0\1\7")
    assert same[0].tobytes() == b"\0\1\1"
    assert all(np.shares_memory(each, same[0]) for each in same)


def test_numbers_of_numpy_become_pythons_and_keep_their_value() -> None:
    sent = encode_result((np.float32(0.1), np.int64(3), np.bool_(True)))
    assert read(sent, tuple[float, int, bool]) == (float(np.float32(0.1)), 3, True)
    assert read(encode_result(Path(os.fsdecode(b"\xff"))), Path) == Path(os.fsdecode(b"\xff"))
    for unknown in (object(), {"a": {1}}, np.zeros(1, object)):
        with pytest.raises(TypeError):
            encode_result(unknown)


@for_each("hint", [object, set[int], Callable[[], int], type, np.ndarray])
def test_a_type_that_could_not_be_checked_is_refused(hint: Any) -> None:
    with pytest.raises(TypeError, match="declare what it is"):
        result_reader(declaring(hint))


def test_errors_are_sentences_of_known_types() -> None:
    rows: list[tuple[tuple[str, ...], type[Exception]]] = [
        (("rejected", "no_faces", "nothing\x1b[2Jthere"), Rejected),
        (("TrilightError", "x: is\x07 wrong."), TrilightError),
        (("EnvironmentFailure", "the disk is full."), EnvironmentFailure),
        (("exception", "\x1b]0;"), ChildFailed),
        (("rejected", "No Reason", "x"), ChildFailed),
        (("KeyError", "x"), ChildFailed),
        (("timeout_cpu", "a verdict"), ChildFailed),
    ]
    for error, kind in rows:
        with case(error), pytest.raises(kind) as caught:
            read(encode_error(*error), int)
        assert type(caught.value) is kind
        assert str(caught.value).isprintable()
        assert not getattr(caught.value, "is_verdict", False)


class Hostile:
    """What, unpickled, makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[[Path], None], tuple[Path]]:
        return Path.touch, (self.path,)


@pytest.fixture
def child() -> Iterator[IsolatedChild]:
    with closing(IsolatedChild(limits=LIMITS)) as child:
        yield child


def test_a_hostile_pickle_makes_no_file(tmp_path: Path) -> None:
    code = pickle.dumps(Hostile(tmp_path / "made"))
    for parts in ([code], [b'["result"]', code], [b'["result"]', b"[0]", code]):
        with pytest.raises(ChildFailed, match="nonsense"):
            read(parts, int)
    assert not (tmp_path / "made").exists()
    pickle.loads(code)
    assert (tmp_path / "made").exists(), "the bytes are hostile indeed"


def test_an_answer_that_is_larger_than_its_child_may_be_is_not_read(child: IsolatedChild) -> None:
    for claim, said in (
        ([1, 1 << 60], "1152921504606846976 bytes"), ([1, 3 * 10**9], f"at most {1 << 30}"),
        ([1 << 40], "parts"), ([3, *[(1 << 64) - 1] * 3], "bytes"),
    ):  # fmt: skip
        with pytest.raises(ChildFailed, match=f"nonsense: its answer would have .*{said}"):
            child.call(called.taken_over, [np.array(claim, "<u8").tobytes()], 0.0)


def test_an_answer_that_never_ends_does_and_a_child_that_reads_no_more_is_given_up() -> None:
    """Pieces of an answer, each of which comes in time, do not hold its owner."""
    # for calls that must come to the end of their time; others may be slow on a busy machine
    limits = dataclasses.replace(LIMITS, wall_s=1.5)
    with closing(IsolatedChild(limits=limits)) as hurried:
        began_s = time.monotonic()
        with pytest.raises(ChildFailed, match="timeout_wall"):
            hurried.call(called.taken_over, [frame(bytes(200))[:16], *([b"x"] * 199)], 0.1)
        assert time.monotonic() - began_s < 15  # a busy machine starts a child in that
        hurried.call(called.deaf, frame(*encode_result(1)))
        with pytest.raises(ChildFailed, match="timeout_wall"):
            hurried.call(called.length_of, bytes(8 << 20))


def test_an_owner_without_memory_for_an_answer_has_a_failed_call(
    child: IsolatedChild, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = np.zeros

    def zeros(count: int, *more: Any) -> NDArray[Any]:
        if count > 1 << 20:
            raise MemoryError
        return real(count, *more)

    monkeypatch.setattr(answers.np, "zeros", zeros)
    with pytest.raises(ChildFailed, match="out_of_memory: this process has no memory"):
        child.call(called.large)
    assert child.call(called.double, 4) == 8


def test_values_come_whole_and_only_as_their_function_declares_them(child: IsolatedChild) -> None:
    with pytest.raises(ChildFailed, match="nonsense: .*lie.*valid integer"):
        child.call(called.lie)
    with pytest.raises(TypeError, match="declare what it is"):
        child.call(called.anything)
    assert child.call(called.large) == called.large()
    with closing(child), pytest.raises(ChildFailed, match="status 3"):
        child.call(os._exit, 3)  # a builtin returns nothing


CALLS = {"call_with_retries": 1, "_exchange": 0, "call": 0, "call_method": 0, "_read": 0}
"""Who calls in a child, and which of its arguments is the function."""


def _called() -> Iterator[tuple[str, str]]:
    """Yield module and source text of what is handed to such a call by its name."""
    for path in sorted(
        path for top in ("pipeline", "infra") for path in (ROOT / top).rglob("*.py")
    ):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            who, *args = [node.func, *node.args]
            if ast.unparse(who) == "partial":
                who, *args = args
            at = CALLS.get(getattr(who, "attr", getattr(who, "id", "")), 99)
            for each in map(ast.walk, args[at : at + 1]):  # each of `a if b else c`
                yield from (
                    (module, ast.unparse(one))
                    for one in each
                    if isinstance(one, ast.Name | ast.Attribute)
                )


def test_what_is_called_in_children_declares_what_can_be_checked() -> None:
    pytest.importorskip("torch", reason="some of it needs torch")
    known: dict[tuple[str, str], Any] = {}
    for module, name in _called():
        with contextlib.suppress(AttributeError):  # a name within a function
            held = importlib.import_module(module_name(module))
            known[module, name] = operator.attrgetter(name)(held)
    known = {key: one for key, one in known.items() if inspect.isfunction(one)}
    assert len(known) > 35, "the walk finds them"
    assert {name for _, name in known} >= {"attempt_in_child", "SceneWorker.attempt", "load_source"}
    undeclared = {}
    for each, function in known.items():
        try:
            assert "return" in function.__annotations__, "says nothing"
            result_reader(function)
        except (TypeError, AssertionError) as error:
            undeclared[each] = str(error)
    assert not undeclared


def test_a_real_answer_is_as_declared(tmp_path: Path) -> None:
    """Of meshes and renders too: tests/infra/child_here.py reads each answer as an owner does."""
    write_scene(tiny_scene(), tmp_path / "scene.json")
    source = SceneSource(path=tmp_path / "scene.json", key=None)
    calls: list[tuple[Callable[..., Any], Any]] = [
        (each, each(source)) for each in (load_source, load_cameras, source_keys)
    ]
    calls.append((convert_sources, convert_sources([source], tmp_path / "out.glb", None)))
    for function, value in calls:
        sent = encode_result(value)
        answer = decode_answer([np.frombuffer(part, np.uint8).copy() for part in sent], function)
        assert isinstance(answer, type(value) | tuple)
        assert encode_result(answer) == sent
