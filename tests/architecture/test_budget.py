"""What the project may weigh: lines, words and options; budget.json is raised with a reason.

`python -m tests.architecture.test_budget` prints the counts.
"""

import ast
import io
import json
import sys
import tokenize
from collections import Counter

from infra.setup.generated_pages import every_command
from tests.command_line import run_program
from tests.conftest import BUDGET, ROOT

PROGRAMS = (".py", ".js", ".html", ".jinja", ".css", ".sh", ".sbatch")
VENDORED = ("infra/viewer/static/three/", "docs/assets/")
BENCH = "infra/bench"
"""Counted apart from the rest of infra."""
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
    tokenize.ENCODING,
}


def _tracked() -> list[str]:
    listed = run_program(["git", "ls-files", "-z"])
    return [name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def count_code_lines(source: str) -> int:
    """Return how many lines of a Python source have code: no blanks, comments or docstrings."""
    lines = set[int]()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        for inner in ast.iter_child_nodes(node):
            if isinstance(inner, ast.Expr) and isinstance(inner.value, ast.Constant):
                lines.difference_update(range(inner.lineno, (inner.end_lineno or 0) + 1))
    return len(lines)


def count_lines() -> dict[str, dict[str, int]]:
    """Return lines of program text and lines of Python code, by package."""
    lines, code = Counter[str](), Counter[str]()
    for name in _tracked():
        if name.endswith(PROGRAMS) and "/" in name and not name.startswith(VENDORED):
            package = BENCH if name.startswith(f"{BENCH}/") else name.split("/")[0]
            text = (ROOT / name).read_text()
            lines[package] += len(text.splitlines())
            code[package] += count_code_lines(text) if name.endswith(".py") else 0
    return {name: {"lines": lines[name], "code": code[name]} for name in sorted(lines)}


def count_words() -> dict[str, int]:
    """Return words of the README, and of all documents that people write."""
    counts = {name: len((ROOT / name).read_text().split()) for name in _tracked() if ".md" in name}
    return {"README": counts["README.md"], "documents": sum(counts.values())}


def count_options() -> int:
    """Return how many options and arguments all commands have together."""
    return sum(len(command.options) for command in every_command())


def test_no_package_outgrows_its_budget() -> None:
    for package, counts in count_lines().items():
        for kind, number in counts.items():
            most = BUDGET["packages"].get(package, {}).get(kind, 0)
            assert number <= most, f"{package}: {number} {kind}, at most {most} in budget.json"


def test_documents_and_options_stay_within_the_budget() -> None:
    for name, number in {**count_words(), "options": count_options()}.items():
        assert number <= BUDGET[name], f"{name}: {number}, at most {BUDGET[name]} in budget.json"


def test_a_line_of_code_has_more_than_prose() -> None:
    source = '"""Prose."""\n\n# comment\ndef f() -> str:\n    """Prose.\n\n    More.\n    """\n'
    assert count_code_lines(source + '    return """\n    text\n    """  # told\n\nX = 1\n') == 5


if __name__ == "__main__":
    found = {"packages": count_lines(), **count_words(), "options": count_options()}
    sys.stdout.write(json.dumps(found, indent=1) + "\n")
