"""Settings by dotted names: the right value changes, nothing else, and mistakes are one line."""

import dataclasses
import json
import re
from collections.abc import Callable
from dataclasses import field
from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

from storage.errors import TrilightError
from storage.settings import fields
from storage.settings.described import checked
from storage.settings.fields import array_scalar, describe_fields
from storage.settings.overrides import apply_overrides
from storage.settings.ranges import EXECUTION, Within
from tests.for_each import case, for_each


@checked()
class Leaf:
    size: float = 1.5
    count: int = 3
    name: str = "leaf"
    flag: bool = False
    pair: tuple[float, float] = (0.5, 1.0)
    whole: tuple[int, ...] = (4, 2, 1)
    words: tuple[str, ...] = ("a", "b")
    maybe: int | None = None

    def __post_init__(self) -> None:
        if self.size < 0:
            raise TrilightError(f"size is {self.size}; expected numbers from 0.")


@checked()
class Branch:
    leaf: Leaf = field(default_factory=Leaf)
    leaves: tuple[Leaf, ...] = (Leaf(), Leaf(count=5), Leaf(name="last"))
    height: float = 2.0


@checked()
class Tree:
    branch: Branch = field(default_factory=Branch)
    branches: tuple[Branch, ...] = (Branch(), Branch(height=7.0))
    age: int = 100


TREE = Tree()


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Every single setting by its path, with the rows of lists of groups."""
    found: dict[str, Any] = {}
    for entry in dataclasses.fields(settings):
        value, name = getattr(settings, entry.name), f"{prefix}{entry.name}"
        if dataclasses.is_dataclass(value):
            found |= _flat(value, f"{name}.")
        elif isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0]):
            for row, group in enumerate(value):
                found |= _flat(group, f"{name}[{row}].")
        else:
            found[name] = value
    return found


finite = st.floats(0, 1e300)
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "size": finite | st.integers(0, 2**60),
    "count": st.integers(),
    "name": st.text(),
    "flag": st.booleans(),
    "pair": st.tuples(finite, finite).map(list),
    "whole": st.lists(st.integers(), min_size=1, max_size=5),
    "words": st.lists(st.text(), max_size=5),
}


@given(
    st.sampled_from(["branch.leaf", "branch.leaves", "branches.leaf", "branches.leaves"]),
    st.sampled_from(sorted(VALUES)),
    st.data(),
)
def test_the_named_settings_change_and_no_others(
    place: str, name: str, data: st.DataObject
) -> None:
    value = data.draw(VALUES[name])
    before, after = _flat(TREE), _flat(apply_overrides(TREE, {f"{place}.{name}": value}))
    assert list(before) == list(after)
    expected = tuple(value) if isinstance(value, list) else value
    hits = 0
    for path, old in before.items():
        if re.sub(r"\[.\]", "", path) == f"{place}.{name}":
            hits += 1
            assert after[path] == type(old)(expected)  # a whole number may become a float
            assert type(after[path]) is type(old)
        else:
            assert after[path] == old
    sizes = {"branch.leaf": 1, "branch.leaves": 3, "branches.leaf": 2, "branches.leaves": 6}
    assert hits == sizes[place]


@given(
    st.dictionaries(
        st.sampled_from(["age", "branch.leaf.count", "branches.height"]), st.integers(0, 99)
    )
)
def test_several_changes_are_one_after_the_other(changes: dict[str, int]) -> None:
    step = TREE
    for name, value in changes.items():
        step = apply_overrides(step, {name: value})
    assert apply_overrides(TREE, changes) == step
    assert apply_overrides(step, changes) == step
    assert Tree() == TREE


def test_values_come_as_json_has_them_and_entries_and_groups_may_be_named() -> None:
    """A whole number for a float becomes one, so that the manifest says 2.0 whoever writes it."""
    text = '{"branch.height": 2, "branch.leaf.pair": [0, 1], "branch.leaf.whole": [9]}'
    after = apply_overrides(TREE, json.loads(text))
    assert repr(after.branch.height) == "2.0"
    assert repr(after.branch.leaf.pair) == "(0.0, 1.0)"
    assert after.branch.leaf.whole == (9,)
    assert apply_overrides(TREE, {"branch.leaf.maybe": 7}).branch.leaf.maybe == 7
    raised = apply_overrides(TREE, {"branches.1.height": 3})
    assert [branch.height for branch in raised.branches] == [2.0, 3.0]
    paired = apply_overrides(TREE, {"branches.0.leaves.1.pair": [0, 2]})
    assert paired.branches[0].leaves[1].pair == (0, 2)
    after = apply_overrides(TREE, {"branches": [{"height": 9}], "branches.0.leaf.count": 4})
    assert after.branches == (Branch(height=9.0, leaf=Leaf(count=4)),)
    assert apply_overrides(TREE, {"branch": {"height": 1}}).branch == Branch(height=1.0)


WRONG: list[tuple[str, Any, str]] = [
    ("", 1, "does not exist"),
    ("ages", 1, "'ages' is unknown there; did you mean age? Expected one of branch, branches, age"),
    ("branches.leaves.colour", 1, "'colour'"),
    (".age", 1, "does not exist"),
    ("branch", {"heigt": 1.0}, "'branch.heigt' does not exist; did you mean height?"),
    ("branch", 1, "is a group"),
    ("branches", [{"height": 1.0}, {"leaf": {"size": "x"}}], "'branches.1.leaf.size' is 'x'"),
    ("branches.2.height", 1, "the list has 2 entries"),
    ("branches.0", 1, "expected one of its settings by name"),
    ("age.days", 1, "'age' has no settings within"),
    ("age", 1.5, "expected a whole number"),
    ("branch.height", "2", "expected a number"),
    ("branch.leaf.flag", 1, "expected true or false"),
    ("branch.leaf.name", 5, "expected a text"),
    ("branch.leaf.pair", 0.5, "expected a list, each entry a"),
    ("branch.leaf.words", [1, 2], "expected a list, each entry a"),
    ("branch.leaf.size", -1.0, "size is -1.0; expected numbers from 0"),
    ("branches.leaves.size", -1, "size is -1.0; expected numbers from 0"),
]


@for_each(("name", "value", "message"), WRONG)
def test_a_mistake_is_one_line_that_says_what_to_do(name: str, value: Any, message: str) -> None:
    with pytest.raises(TrilightError) as caught:
        apply_overrides(TREE, {name: value})
    text = str(caught.value)
    assert message in text
    assert "\n" not in text
    if not message.startswith("size"):
        assert f"'{name}" in text


@given(st.text(st.characters(codec="ascii"), max_size=12), st.integers() | st.text() | st.none())
def test_any_name_and_value_give_settings_or_a_clear_refusal(name: str, value: Any) -> None:
    try:
        assert isinstance(apply_overrides(TREE, {name: value}), Tree)
    except TrilightError as error:
        assert "\n" not in str(error)


@checked()
class Span:
    low: int = 32
    high: int = 256

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise TrilightError(f"{self.low} to {self.high}; expected low <= high.")


@checked()
class Spans:
    one: Span = field(default_factory=Span)
    many: tuple[Span, ...] = (Span(), Span())


@for_each("names", [("low", "high"), ("high", "low")])
def test_values_that_only_fit_each_other_come_in_any_order(names: tuple[str, str]) -> None:
    numbers = {"low": 8, "high": 16}
    for group in ("one", "many"):
        found = apply_overrides(Spans(), {f"{group}.{name}": numbers[name] for name in names})
        new = found.one if group == "one" else found.many[1]
        assert (new.low, new.high) == (8, 16)
    with pytest.raises(TrilightError, match=r"settings 'one\.(low|high)', .*: 9 to 8; expected"):
        apply_overrides(Spans(), {f"one.{name}": {"low": 9, "high": 8}[name] for name in names})
    with pytest.raises(TrilightError, match=r"^setting 'many\.high': 32 to 8; expected"):
        apply_overrides(Spans(), {"many.high": 8})


@checked()
class Engine:
    power: int = 1
    fuel: str = "wood"

    PRESETS: ClassVar[dict[str, Callable[[], "Engine"]]] = {
        "small": lambda: Engine(power=2),
        "large": lambda: Engine(power=9, fuel="coal"),
    }


@checked()
class Car:
    engine: Engine = field(default_factory=Engine)
    wheels: int = 4


@for_each("backwards", [False, True])
def test_a_group_with_presets_may_be_named_and_then_changed(backwards: bool) -> None:
    changes = {"engine": "large", "engine.power": 8, "wheels": 3}
    ordered = dict(reversed(changes.items())) if backwards else changes
    assert apply_overrides(Car(), ordered) == Car(engine=Engine(power=8, fuel="coal"), wheels=3)
    assert apply_overrides(Car(), {"engine": "small"}) == Car(engine=Engine(power=2))


def test_a_wrong_preset_or_name_is_asked_back() -> None:
    wrong: list[tuple[dict[str, Any], str]] = [
        (
            {"engine": "lrage"},
            r"is 'lrage'; did you mean large\? Expected one of small, .*e\.power",
        ),
        ({"engine": ["large"]}, r"'engine' is \['large'\]; .*xpected one of small, large"),
        ({"engine.powr": 3}, r"'engine\.powr' does not exist.* did you mean power\? Expected one"),
    ]
    for changes, message in wrong:
        with case(changes), pytest.raises(TrilightError, match=message):
            apply_overrides(Car(), changes)


Count = Annotated[int, Within(1, 9)]


@checked("group")
class Group:
    """One of each."""

    plain: int
    """Meaning."""
    ranged: Count = 1
    """Meaning, with a range."""
    marked: Annotated[int, Within(1, 9), EXECUTION] = 1
    """Marked after its range."""
    alias: Annotated[Count, EXECUTION] = 1
    """Marked around an alias."""
    switch: Annotated[bool, EXECUTION] = False
    """Marked alone."""


def test_what_is_marked_is_described_so_and_keeps_its_range() -> None:
    by_name = {field.name: field for field in describe_fields(Group)}
    marked = {name for name, field in by_name.items() if field.is_execution}
    assert marked == {"marked", "alias", "switch"}
    assert by_name["marked"].expected == by_name["ranged"].expected
    assert by_name["switch"].expected == "true or false"
    with pytest.raises(TrilightError, match="marked is 10; expected a whole number from 1 to 9"):
        Group(plain=0, marked=10)
    with pytest.raises(TrilightError, match="switch is 1; expected true or false"):
        Group(plain=0, switch=1)  # type: ignore[arg-type]


_Kept = TypeVar("_Kept", bound=np.generic)
AliasOfLater = TypeAliasType(  # what numpy 2.5 has in the place of NDArray
    "AliasOfLater", np.ndarray[Any, np.dtype[_Kept]], type_params=(_Kept,)
)


@for_each("scalar", [np.float32, np.int64, np.floating[Any]])
def test_the_scalar_is_read_of_either(scalar: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert array_scalar(NDArray[scalar]) == scalar
    monkeypatch.setattr(fields, "NDArray", AliasOfLater)
    assert array_scalar(AliasOfLater[scalar]) == scalar
    assert array_scalar(tuple[int, int]) is array_scalar(int) is None
