"""Parses and evaluates conditions on scenes, such as `max(roughness) < 0.3 and template == "room"`.

The syntax is Python's, parsed by `ast` and evaluated here: names come from a table, the functions
are min, max, mean, any and all over values that a scene has several of, and nothing else can be
called. Type errors are reported before any scene is read.
"""

import ast
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

import numpy as np

from storage.errors import TrilightError
from storage.records.quantities import QUANTITIES

Kind = Literal["number", "text", "truth", "numbers", "texts", "truths"]
"""Type of a value; the plural is a list of values of one scene."""

TEXTS: Mapping[str, tuple[Kind, str]] = {
    "key": ("text", "nine digits, the scene's index"),
    "split": ("text", "train, validation or test"),
    "template": ("text", "layout of the scene"),
    "excursion": ("text", "what of the scene is out of the usual range; empty if nothing is"),
    "uid": ("texts", "its objects"),
    "licence": ("texts", "licences of its objects, shells and lights"),
    "at_cap": ("truths", "whether a view ended at the cap before its target, for each view"),
}
"""Names beside those of storage.records.quantities, with type and meaning."""

_COMPARISONS: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
    ast.Eq: operator.eq, ast.NotEq: operator.ne,
}  # fmt: skip
_OPERATIONS: Mapping[Any, tuple[Kind, Kind, Callable[..., Any]]] = {
    ast.Not: ("truth", "truth", operator.not_),
    ast.USub: ("number", "number", operator.neg),
    ast.Add: ("number", "number", operator.add),
    ast.Sub: ("number", "number", operator.sub),
    ast.Mult: ("number", "number", operator.mul),
    ast.Div: ("number", "number", lambda a, b: np.float64(a) / b),
    ast.List: ("text", "texts", lambda *texts: texts),
    ast.Tuple: ("text", "texts", lambda *texts: texts),
    "min": ("numbers", "number", lambda values: min(values, default=np.nan)),
    "max": ("numbers", "number", lambda values: max(values, default=np.nan)),
    "mean": ("numbers", "number", lambda values: np.mean(values) if len(values) else np.nan),
    "any": ("truths", "truth", any),
    "all": ("truths", "truth", all),
}
"""Type of all arguments, type of the result, and function of each operator, list or named function.
The result of a function for no values is NaN, and no comparison with it holds."""
_FUNCTIONS = [name for name in _OPERATIONS if isinstance(name, str)]

Values = Mapping[str, Any]
"""Values of one scene, by name."""


@dataclass(frozen=True, kw_only=True)
class _Term:
    kind: Kind
    of: Callable[[Values], Any]


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A parsed condition."""

    names: frozenset[str]
    """Names of the values that the condition uses."""
    holds: Callable[[Values], bool]
    """Returns True if the condition holds for a scene with these values."""


def kind_of(name: str) -> Kind | None:
    """Return the type of a known name; None for other names."""
    if name in TEXTS:
        return TEXTS[name][0]
    if name in QUANTITIES:
        return "number" if QUANTITIES[name].per == "scene" else "numbers"
    return None


def condition(text: str) -> Condition:
    """Parse a condition.

    Raises:
        TrilightError: it is not an expression, has an unknown name, or compares unlike types.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        reader = _Reader(text)
        part = reader.read(tree)
    except TrilightError:
        raise
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise TrilightError(
            f"--where {text!r:.80}: not an expression ({getattr(error, 'msg', error)}); expected "
            'one such as: min(noise_floor_db) >= 42 and template == "plane".'
        ) from None
    if part.kind != "truth":
        reader.refuse(tree, part.kind, "a comparison")
    return Condition(
        names=frozenset(node.id for node in ast.walk(tree) if isinstance(node, ast.Name))
        - {*_FUNCTIONS},
        holds=lambda values: bool(part.of(values)),
    )


class _Reader:
    """Converts a syntax tree to a function, with type checks."""

    def __init__(self, text: str) -> None:
        self._text = text

    def refuse(self, node: ast.AST, got: str, expected: str) -> NoReturn:
        """Raise TrilightError for a part of the text that is not of the expected type."""
        part = ast.get_source_segment(self._text.strip(), node) or self._text
        raise TrilightError(f"--where: {part!r:.60} is {_article(got)}; expected {expected}.")

    def read(self, node: ast.expr) -> _Term:
        operation: Any = None
        parts: list[ast.expr] = []
        match node:
            case ast.Constant(value=bool() | int() | float() | str() as value):
                kinds: Mapping[type, Kind] = {bool: "truth", str: "text"}
                return _Term(kind=kinds.get(type(value), "number"), of=lambda _: value)
            case ast.Name(id=name):
                if (known := kind_of(name)) is None:
                    names = ", ".join(sorted({*TEXTS, *QUANTITIES}))
                    self.refuse(node, "unknown", f"one of {names}")
                return _Term(kind=known, of=lambda values: values[name])
            case ast.Compare(left=left, ops=ops, comparators=others):
                terms = [self.read(side) for side in (left, *others)]
                pairs = zip(others, terms, terms[1:], ops, strict=False)
                tests = [self._test(*pair) for pair in pairs]
                return _Term(kind="truth", of=lambda values: all(test(values) for test in tests))
            case ast.BoolOp(op=op, values=parts):
                truths = [self._read_kind(part, "truth").of for part in parts]
                every = all if isinstance(op, ast.And) else any  # the first may guard the next
                return _Term(kind="truth", of=lambda values: every(of(values) for of in truths))
            case ast.UnaryOp(op=unary, operand=part):
                operation = type(unary)
                parts = [part]
            case ast.BinOp(op=binary, left=left, right=right):
                operation = type(binary)
                parts = [left, right]
            case ast.Tuple(elts=parts) | ast.List(elts=parts):
                operation = type(node)
            case ast.Call(func=ast.Name(id=name), args=[part], keywords=[]):
                operation = name
                parts = [part]
        if operation not in _OPERATIONS:
            self.refuse(
                node, "nothing that a condition may hold", f"{', '.join(_FUNCTIONS)}, comparisons, "
                "and, or, not, + - * /, numbers, texts and names"
            )  # fmt: skip
        takes, gives, function = _OPERATIONS[operation]
        each = [self._read_kind(part, takes).of for part in parts]
        return _Term(kind=gives, of=lambda values: function(*(of(values) for of in each)))

    def _read_kind(self, node: ast.expr, kind: Kind) -> _Term:
        part = self.read(node)
        if part.kind != kind:
            self.refuse(node, part.kind, _HINTS.get((part.kind, kind), _article(kind)))
        return part

    def _test(
        self, node: ast.expr, first: _Term, second: _Term, op: ast.cmpop
    ) -> Callable[[Values], Any]:
        if isinstance(op, ast.In | ast.NotIn) and (first.kind, second.kind) == ("text", "texts"):
            expected = isinstance(op, ast.In)
            return lambda values: (first.of(values) in second.of(values)) == expected
        same = isinstance(op, ast.Eq | ast.NotEq)
        if type(op) not in _COMPARISONS or first.kind != second.kind or first.kind not in (
            ("number", "text", "truth") if same else ("number",)
        ):  # fmt: skip
            self.refuse(
                node,
                f"{_article(second.kind)} beside {_article(first.kind)}",
                _HINTS.get((second.kind, first.kind))
                or _HINTS.get((first.kind, second.kind))
                or "what can be compared so",
            )
        compare = _COMPARISONS[type(op)]
        return lambda values: compare(first.of(values), second.of(values))


_HINTS = {
    ("numbers", "number"): "min(...), max(...) or mean(...) of it: a scene has several",
    ("numbers", "numbers"): "min(...), max(...) or mean(...) of each: a scene has several",
    ("truths", "truth"): "any(...) or all(...) of it: a scene has several",
    ("texts", "text"): '"..." in it: a scene has several',
}


def _article(kind: str) -> str:
    return {"number": "a number", "text": "a text", "truth": "a truth"}.get(kind, kind)
