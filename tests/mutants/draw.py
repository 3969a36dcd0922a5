"""The draw of mutants: changes of single lines that a test must notice, chosen by a seed.

`python -m tests.mutants.draw [N]` prints the first N of each kind and package, as lines of JSON.
The list beside this file holds, of each that can change what a program does, the first two of the
first draw and the first one of the second.
"""

import ast
import hashlib
import io
import itertools
import json
import re
import subprocess
import sys
import tarfile
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

DRAWS = {
    "": (20261127, "dbd5de6f792d44ec2c4508b01f4f70e28e08787f"),
    "second-": (20261129, "601073e8550c21dfca0f5fc2c19588c0c0f043fd"),
}
"""Seed and commit, whose source is drawn from, by the beginning of the names."""
PACKAGES = ("storage", "scene_templates", "pipeline", "model", "train", "infra", "trilight")
KINDS = ("sign", "bound", "order", "guard", "constant")
REMOVED = re.compile(
    r"infra/(bench|fake_card|improve|run_page|setup)/.*|infra/serving/improve_loop\.py"
    r"|infra/cli/(bench|bench_card|improve|layer_plot)\.py|infra/viewer/run_room\.py"
    r"|pipeline/executors/arrays/(aws_batch|google_batch|sky)\.py|pipeline/renders/plugin_.*\.py"
    r"|pipeline/making/(lock|object)_parts\.py|pipeline/documents/gallery_controls\.py"
    r"|model/(texture_cells|projected|empty_bundles|layer_errors)\.py|model/sky/.*"
    r"|train/loss/half_features\.py"
)
"""Files that no mutant is drawn from: the commits after the draw remove them."""
SIGNS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
BOUNDS = {ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">")}
NON_COMMUTATIVE = (ast.Sub, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow, ast.MatMult)
SIMPLE = (ast.Assign, ast.AnnAssign, ast.AugAssign, ast.Expr)


@dataclass(frozen=True)
class Change:
    """What stands in place of the characters from `first` to before `last`."""

    kind: str
    first: int
    last: int
    text: str


class Source:
    """A file, its tree, and the places of its nodes."""

    def __init__(self, path: str, text: str) -> None:
        self.path, self.text, self.tree = path, text, ast.parse(text)
        self.lines = text.splitlines(keepends=True)
        self.starts = [0, *itertools.accumulate(map(len, self.lines))]

    def span(self, node: Any) -> tuple[int, int]:
        """Return the offsets of a node; its columns count bytes."""
        first, last = self.lines[node.lineno - 1], self.lines[node.end_lineno - 1]
        return (
            self.starts[node.lineno - 1] + len(first.encode()[: node.col_offset].decode()),
            self.starts[node.end_lineno - 1] + len(last.encode()[: node.end_col_offset].decode()),
        )

    def of(self, node: ast.AST) -> str:
        return self.text[slice(*self.span(node))]

    def definitions(self) -> Iterator[tuple[str, int, int]]:
        """Yield the dotted name and the first and last offset of each function and class."""
        yield "<module>", 0, len(self.text)
        names: dict[ast.AST, str] = {self.tree: ""}
        for parent in ast.walk(self.tree):
            for node in ast.iter_child_nodes(parent):
                names[node] = names[parent]
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                    names[node] = f"{names[parent]}.{node.name}".lstrip(".")
                    top = min([node.lineno, *(each.lineno for each in node.decorator_list)])
                    yield names[node], self.starts[top - 1], self.span(node)[1]


def changes(source: Source) -> Iterator[Change]:
    """Yield every change that may be drawn from a file."""
    nodes = list(ast.walk(source.tree))
    hidden = {each for node in nodes for part in _hidden(node) for each in ast.walk(part)}
    rules = (_signs, _bounds, _orders, _guards, _constants)
    for node, find in itertools.product((each for each in nodes if each not in hidden), rules):
        yield from find(source, node)


def _hidden(node: ast.AST) -> Iterator[ast.AST]:
    """Yield messages and sentences below fields, and strings that are names of fields and draws."""
    parts = list[ast.AST | None]()
    if isinstance(node, ast.Raise | ast.JoinedStr):
        yield node
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        yield node.value
    elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("rng_for", "seed_for"):
        parts += node.args
    elif isinstance(node, ast.ClassDef):
        parts += [each for each in node.body if isinstance(each, ast.Assign | ast.AnnAssign)]
    elif isinstance(node, ast.AnnAssign | ast.arg | ast.FunctionDef):
        parts += [node.returns if isinstance(node, ast.FunctionDef) else node.annotation]
    elif isinstance(node, ast.Compare) and getattr(node.left, "id", "") == "__name__":
        parts += node.comparators
    for each in (each for part in filter(None, parts) for each in ast.walk(part)):
        if isinstance(each, ast.Constant) and isinstance(each.value, str):
            yield each


def _is_text(node: ast.AST) -> bool:
    kinds = ast.JoinedStr | ast.List | ast.Tuple
    return isinstance(node, kinds) or isinstance(getattr(node, "value", None), str)


def _between(kind: str, source: Source, left: ast.AST, right: ast.AST, op: Any) -> Change:
    old, new = (SIGNS | BOUNDS)[type(op)]
    first = source.text.index(old, source.span(left)[1], source.span(right)[0])
    return Change(kind, first, first + len(old), new)


def _signs(source: Source, node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in SIGNS:
        sides = (
            (node.left, node.right) if isinstance(node, ast.BinOp) else (node.target, node.value)
        )
        if not any(map(_is_text, sides)):
            yield _between("sign", source, *sides, node.op)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield Change("sign", *source.span(node), source.of(node.operand))


def _bounds(source: Source, node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.Compare):
        sides = itertools.pairwise([node.left, *node.comparators])
        for op, (left, right) in zip(node.ops, sides, strict=True):
            if type(op) in BOUNDS:
                yield _between("bound", source, left, right, op)
    elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "range":
        end = node.args[min(len(node.args) - 1, 1)]
        if not isinstance(end, ast.Starred):
            yield Change("bound", *source.span(end), f"({source.of(end)}) - 1")


def _orders(source: Source, node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.Call) and not any(isinstance(a, ast.Starred) for a in node.args):
        for left, right in itertools.pairwise(node.args):
            yield from _swapped(source, left, right)
        if getattr(node.func, "id", "") == "sorted" and "reverse" not in source.of(node):
            _, last = source.span(node)
            yield Change("order", last - 1, last, ", reverse=True)")
    elif isinstance(node, ast.BinOp) and isinstance(node.op, NON_COMMUTATIVE):
        if not (_is_text(node.left) or _is_text(node.right)):
            yield from _swapped(source, node.left, node.right)
    for body in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
        if isinstance(body, list):
            for above, below in itertools.pairwise(body):
                both = _stored(above) & _loaded(below) or _stored(below) & _loaded(above)
                if both and isinstance(above, SIMPLE) and isinstance(below, SIMPLE):
                    yield from _swapped(source, above, below)


def _swapped(source: Source, left: ast.AST, right: ast.AST) -> Iterator[Change]:
    (first, end), (start, last) = source.span(left), source.span(right)
    one, other = source.of(left), source.of(right)
    if one != other:
        yield Change("order", first, last, other + source.text[end:start] + one)


def _stored(node: ast.AST) -> set[str]:
    """Return the names that a statement may change: targets, and what it calls a method of."""
    targets = [*getattr(node, "targets", []), getattr(node, "target", None)]
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        targets.append(node.value.func)
    return set[str]().union(*(_loaded(target) for target in targets if target is not None))


def _loaded(node: ast.AST) -> set[str]:
    """Return the names in a statement; each attribute of `self` is one."""
    kinds = ast.Name | ast.Attribute
    texts = [ast.unparse(each) for each in ast.walk(node) if isinstance(each, kinds)]
    return {text for text in texts if re.fullmatch(r"(?!self$)\w+|self\.\w+", text)}


def _guards(source: Source, node: ast.AST) -> Iterator[Change]:
    leaves = ast.Raise | ast.Return | ast.Continue
    if isinstance(node, ast.If) and isinstance(node.body[-1], leaves):
        yield Change("guard", *source.span(node.test), "False")


def _constants(source: Source, node: ast.AST) -> Iterator[Change]:
    value: Any = node.value if isinstance(node, ast.Constant) else None
    if type(value) in (int, float, str):
        text = new = source.of(node)
        if not isinstance(value, str):
            new = str(value + 1 if isinstance(value, int) else 2 * value or 1.0)
        elif re.fullmatch(r"[\"'][^\s\"']+[\"']", text):
            new = f"{text[:-1]}_{text[-1]}"
        if new != text:
            yield Change("constant", *source.span(node), new)


def described(source: Source, change: Change) -> dict[str, str]:
    """Return where a change is: by its function and the lines, which are told apart by others."""
    inside = [d for d in source.definitions() if d[1] <= change.first and change.last <= d[2]]
    name, top, bottom = min(inside, key=lambda each: each[2] - each[1])
    text = source.text
    first, last = text.rindex("\n", 0, change.first) + 1, text.index("\n", change.last)
    while text.count(text[first:last].strip(), top, bottom) > 1:
        first = text.rindex("\n", 0, first - 1) + 1
    first += len(text[first:last]) - len(text[first:last].lstrip())
    changed = text[first : change.first] + change.text + text[change.last : last]
    return {"path": source.path, "function": name, "source": text[first:last], "changed": changed}


def _sources(commit: str) -> Iterator[Source]:
    """Yield the files of the commit that mutants are drawn from."""
    archive = subprocess.run(["git", "archive", commit, *PACKAGES], capture_output=True, check=True)
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
        for member in files:
            file = files.extractfile(member)
            if file and member.name.endswith(".py") and not REMOVED.fullmatch(member.name):
                yield Source(member.name, file.read().decode())


def drawn(draw: str, number: int) -> Iterator[dict[str, str]]:
    """Yield a draw's first mutants of each kind and package: lines in the order of their hashes."""
    seed, commit = DRAWS[draw]

    def key(*parts: object) -> bytes:
        return hashlib.sha256(":".join(map(str, (seed, *parts))).encode()).digest()

    places = defaultdict[tuple[str, str, Source, int], list[Change]](list)
    for source in _sources(commit):
        for change in changes(source):
            line = source.text.count("\n", 0, change.first) + 1
            places[source.path.split("/")[0], change.kind, source, line].append(change)
    for package, kind in itertools.product(PACKAGES, KINDS):
        lines = [each for each in places if each[:2] == (package, kind)]
        lines.sort(key=lambda each: key(kind, each[2].path, each[3]))
        for n, place in enumerate(lines[:number], 1):
            change = min(places[place], key=lambda each: key(each.first, each.last, each.text))
            name = {"id": f"{draw}{package}-{kind}-{n}", "package": package, "kind": kind}
            yield name | described(place[2], change)


if __name__ == "__main__":
    most = int(sys.argv[1]) if len(sys.argv) > 1 else 2
    for mutant in itertools.chain.from_iterable(drawn(draw, most) for draw in DRAWS):
        sys.stdout.write(json.dumps(mutant, ensure_ascii=False) + "\n")
