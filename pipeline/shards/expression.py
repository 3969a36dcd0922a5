"""Conditions on scenes, such as `max(roughness) < 0.3 and template == "room"`.

The form is that of Python, read by its own parser and carried out by ours: names are those of a
table, functions are min, max, mean, any and all over what a scene has several of, and nothing else
can be called. What does not fit together is refused before any scene is read.
"""

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NoReturn

import numpy as np

from storage.errors import TrilightError
from storage.records.quantities import QUANTITIES

Kind = Literal["number", "text", "truth", "numbers", "texts", "truths"]
"""What a value is; those with an s are several."""

TEXTS: Mapping[str, tuple[Kind, str]] = {
    "key": ("text", "nine digits, the scene's index"),
    "split": ("text", "train, validation or test"),
    "template": ("text", "layout of the scene"),
    "excursion": ("text", "what of the scene is out of the usual range; empty if nothing is"),
    "uid": ("texts", "its objects"),
    "licence": ("texts", "licences of its objects, shells and lights"),
    "at_cap": ("truths", "whether a view ended at the cap before its target, for each view"),
}
"""What can be asked of a scene beside storage.records.quantities, and what it means."""

_COMPARED: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
    ast.Eq: operator.eq, ast.NotEq: operator.ne,
}  # fmt: skip
_COUNTED: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: lambda a, b: np.float64(a) / b,
}  # fmt: skip
_OF_SEVERAL: Mapping[str, tuple[Kind, Kind, Callable[[Any], Any]]] = {
    "min": ("numbers", "number", lambda values: min(values, default=np.nan)),
    "max": ("numbers", "number", lambda values: max(values, default=np.nan)),
    "mean": ("numbers", "number", lambda values: np.mean(values) if len(values) else np.nan),
    "any": ("truths", "truth", any),
    "all": ("truths", "truth", all),
}
"""What each takes and gives; of no values numbers are NaN, and no comparison with it holds."""

Values = Mapping[str, Any]
"""Of one scene, by name."""


@dataclass(frozen=True, kw_only=True)
class _Part:
    kind: Kind
    of: Callable[[Values], Any]


@dataclass(frozen=True, kw_only=True)
class Condition:
    """A condition that has been read."""

    text: str
    """As it was written."""
    names: frozenset[str]
    """Those of the values that it asks for."""
    holds: Callable[[Values], bool]
    """Whether it holds for a scene of these values."""


def kind_of(name: str) -> Kind | None:
    """Return the kind of a name of the tables; None for others."""
    if name in TEXTS:
        return TEXTS[name][0]
    if name in QUANTITIES:
        return "number" if QUANTITIES[name].per == "scene" else "numbers"
    return None


def condition(text: str) -> Condition:
    """Return what a text says.

    Raises:
        TrilightError: it is no expression, names something unknown, or compares what cannot be.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        reader = _Reader(text)
        part = reader.part(tree)
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
        text=text,
        names=frozenset(node.id for node in ast.walk(tree) if isinstance(node, ast.Name))
        - set(_OF_SEVERAL),
        holds=lambda values: bool(part.of(values)),
    )


class _Reader:
    """Turns a tree into a function, kind by kind."""

    def __init__(self, text: str) -> None:
        self._text = text

    def refuse(self, node: ast.AST, got: str, expected: str) -> NoReturn:
        """Raise TrilightError that a part of the text is not what is expected there."""
        part = ast.get_source_segment(self._text.strip(), node) or self._text
        raise TrilightError(f"--where: {part!r:.60} is {_article(got)}; expected {expected}.")

    def part(self, node: ast.expr) -> _Part:
        """Return the meaning of a tree."""
        match node:
            case ast.Constant(value=bool() | int() | float() | str() as value):
                return _Part(kind=_kind(value), of=lambda _: value)
            case ast.Name(id=name):
                return self._named(node, name)
            case ast.Tuple(elts=parts) | ast.List(elts=parts):
                each = [self._wanted(part, "text").of for part in parts]
                return _Part(kind="texts", of=lambda values: [of(values) for of in each])
            case ast.BoolOp(op=op, values=parts):
                truths = [self._wanted(part, "truth").of for part in parts]
                every = all if isinstance(op, ast.And) else any
                return _Part(kind="truth", of=lambda values: every(of(values) for of in truths))
            case ast.UnaryOp(op=ast.Not(), operand=inner):
                truth = self._wanted(inner, "truth").of
                return _Part(kind="truth", of=lambda values: not truth(values))
            case ast.UnaryOp(op=ast.USub(), operand=inner):
                number = self._wanted(inner, "number").of
                return _Part(kind="number", of=lambda values: -number(values))
            case ast.BinOp(op=op, left=left, right=right) if type(op) in _COUNTED:
                a, b = (self._wanted(side, "number").of for side in (left, right))
                count = _COUNTED[type(op)]
                return _Part(kind="number", of=lambda values: count(a(values), b(values)))
            case ast.Compare(left=left, ops=ops, comparators=others):
                return self._compared([left, *others], ops)
            case ast.Call(func=ast.Name(id=name), args=[inner], keywords=[]) if name in _OF_SEVERAL:
                takes, gives, reduce = _OF_SEVERAL[name]
                several = self._wanted(inner, takes).of
                return _Part(kind=gives, of=lambda values: reduce(several(values)))
        self.refuse(
            node, "nothing that a condition may hold", f"{', '.join(_OF_SEVERAL)}, comparisons, "
            "and, or, not, + - * /, numbers, texts and names"
        )  # fmt: skip

    def _named(self, node: ast.expr, name: str) -> _Part:
        kind = kind_of(name)
        if kind is None:
            self.refuse(node, "unknown", f"one of {', '.join(sorted({*TEXTS, *QUANTITIES}))}")
        return _Part(kind=kind, of=lambda values: values[name])

    def _wanted(self, node: ast.expr, kind: Kind) -> _Part:
        part = self.part(node)
        if part.kind != kind:
            self.refuse(node, part.kind, _HINTS.get((part.kind, kind), _article(kind)))
        return part

    def _compared(self, nodes: Sequence[ast.expr], ops: Sequence[ast.cmpop]) -> _Part:
        parts = [self.part(node) for node in nodes]
        pairs = list(zip(nodes[1:], parts, parts[1:], ops, strict=False))
        tests = [self._test(*pair) for pair in pairs]
        return _Part(kind="truth", of=lambda values: all(test(values) for test in tests))

    def _test(
        self, node: ast.expr, left: _Part, right: _Part, op: ast.cmpop
    ) -> Callable[[Values], Any]:
        if isinstance(op, ast.In | ast.NotIn) and (left.kind, right.kind) == ("text", "texts"):
            wanted = isinstance(op, ast.In)
            return lambda values: (left.of(values) in right.of(values)) == wanted
        same = isinstance(op, ast.Eq | ast.NotEq)
        if type(op) not in _COMPARED or left.kind != right.kind or left.kind not in (
            ("number", "text", "truth") if same else ("number",)
        ):  # fmt: skip
            self.refuse(
                node,
                f"{_article(right.kind)} beside {_article(left.kind)}",
                _HINTS.get((right.kind, left.kind))
                or _HINTS.get((left.kind, right.kind))
                or "what can be compared so",
            )
        compare = _COMPARED[type(op)]
        return lambda values: compare(left.of(values), right.of(values))


_HINTS = {
    ("numbers", "number"): "min(...), max(...) or mean(...) of it: a scene has several",
    ("numbers", "numbers"): "min(...), max(...) or mean(...) of each: a scene has several",
    ("truths", "truth"): "any(...) or all(...) of it: a scene has several",
    ("texts", "text"): '"..." in it: a scene has several',
}


def _kind(value: object) -> Kind:
    if isinstance(value, bool):
        return "truth"
    return "text" if isinstance(value, str) else "number"


def _article(kind: str) -> str:
    return {"number": "a number", "text": "a text", "truth": "a truth"}.get(kind, kind)
