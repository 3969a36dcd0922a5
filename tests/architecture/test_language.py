"""The field's language: counts of names and sentences that would need explaining.

language.json holds what is allowed, by package. A count above it fails, and so does one below it:
then lower the number, so that it only shrinks. `python -m tests.architecture.test_language [KIND]`
prints the counts, and each place of one kind.
"""

import ast
import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT

PACKAGES = ("storage", "scene_templates", "pipeline", "model", "train", "infra", "trilight")
MOST_LINES = 60
"""Maximum number of lines of a function."""

_IRREGULAR = (
    "begun bought bound brought built caught chosen cut done drawn found given grown held "
    "kept known laid left lit lost made met paid seen sent set shown spent stood taken "
    "taught thought told worn written"
)
_PARTICIPLE = re.compile(rf"_*(?:[a-z]+ed|{'|'.join(_IRREGULAR.split())})")
_FRAGMENTS = frozenset(
    "again apart asked away begun beside brought enough found given here joined kept left met "
    "needed news odd once others own shown there told turn wanted way ways whole".split()
)
"""Words that name nothing outside of a sentence."""
_PERSON = re.compile(r"(?i)\b(?:who(?:ever|m)|(?:some|no|any|every)body|is told|hears? of)\b")
_HEADLESS = re.compile("(?:Of|In|By|To|With|As|For|From|How many|Its|Their|What|Which|Whether)\\b")
_MOST_EMPTY_WORDS = 4


def _is_property(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(
        ast.unparse(decorator).endswith(("property", ".setter"))
        for decorator in node.decorator_list
    )


def _faults_of_function(node: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[str]:
    if _PARTICIPLE.fullmatch(node.name) and not _is_property(node):
        yield "participle functions"
    if (node.end_lineno or 0) - node.lineno > MOST_LINES:
        yield "long functions"


def _is_packed(node: ast.Assign) -> bool:
    """Return whether unrelated values are assigned in one statement; a swap is none."""
    if not (isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)):
        return False
    names, values = (
        {inner.id for inner in ast.walk(side) if isinstance(inner, ast.Name)}
        for side in (node.targets[0], node.value)
    )
    return names != values


def _empty_docs(node: ast.ClassDef) -> Iterator[tuple[int, str]]:
    """Yield docs of fields that add nothing to the name: few words, or no head noun."""
    for field, doc in zip(node.body, node.body[1:], strict=False):
        if not isinstance(field, ast.AnnAssign):
            continue
        if isinstance(doc, ast.Expr) and isinstance(doc.value, ast.Constant):
            text = str(doc.value.value)
            if len(text.split()) <= _MOST_EMPTY_WORDS or _HEADLESS.match(text):
                yield doc.lineno, text


def faults(text: str) -> Iterator[tuple[str, int, str]]:
    """Yield kind, line and text of each fault of a source."""
    for number, line in enumerate(text.splitlines(), 1):
        if _PERSON.search(line):
            yield "persons", number, line.strip()
    for node in ast.walk(ast.parse(text)):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                for kind in _faults_of_function(node):
                    yield kind, node.lineno, node.name
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()):
                if name.strip("_") in _FRAGMENTS:
                    yield "fragments", node.lineno, name
            case ast.Assign() if _is_packed(node):
                yield "packed assignments", node.lineno, ast.unparse(node)
            case ast.ClassDef():
                for number, text_of_doc in _empty_docs(node):
                    yield "empty field docs", number, text_of_doc


def _sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def count_faults() -> dict[str, dict[str, int]]:
    """Return how many faults of each kind each package has."""
    counts = {}
    for package in PACKAGES:
        kinds = Counter(
            kind for path in _sources(package) for kind, _, _ in faults(path.read_text())
        )
        counts[package] = dict(sorted(kinds.items()))
    return counts


def test_the_language_gets_plainer() -> None:
    allowed = json.loads((ROOT / "tests/architecture/language.json").read_text())
    for package, counts in count_faults().items():
        for kind in {*counts, *allowed[package]}:
            number = counts.get(kind, 0)
            most = allowed[package].get(kind, 0)
            assert number <= most, (
                f"{package}: {number} {kind}, at most {most}; "
                f"python -m tests.architecture.test_language '{kind}' lists them"
            )
            assert number == most, f"{package}: {number} {kind}; lower {most} in language.json"


def test_each_kind_of_fault_is_seen() -> None:
    bad = (
        "def begun(found):\n    a, b = 1, found\nclass C:\n    x: int\n    'Whether it is.'\n"
        "def long():\n" + "    pass\n" * (MOST_LINES + 1) + "# whoever reads\n"
    )
    good = (
        "def begin(claim):\n    a, b = b, a\nclass C:\n    x: int\n"
        "    'Width of a picture, in pixels.'\n"
    )
    assert {kind for kind, _, _ in faults(bad)} == {
        "participle functions", "fragments", "packed assignments", "empty field docs",
        "long functions", "persons",
    }  # fmt: skip
    assert list(faults(good)) == []


def _main(kinds: list[str]) -> None:
    lines = [json.dumps(count_faults(), indent=2)]
    for path in (path for package in PACKAGES if kinds for path in _sources(package)):
        for kind, number, text in faults(path.read_text()):
            if kind in kinds:
                lines.append(f"{path.relative_to(ROOT)}:{number}: {text[:100]}")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    _main(sys.argv[1:])
