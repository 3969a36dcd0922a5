"""The house rules that a machine can hold: size of files and functions, layers, stray words."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT

PACKAGES = ("trilight", "storage", "scene_templates", "pipeline", "model", "train", "infra")
MAX_FILE_LINES, MAX_FUNCTION_LINES = 400, 40


def _sources(*folders: str) -> Iterator[Path]:
    for folder in folders:
        yield from sorted((ROOT / folder).rglob("*.py"))


def _body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines after signature and docstring: prose is free, work is not."""
    body = function.body
    if ast.get_docstring(function) is not None:
        body = body[1:]
    return (function.end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_files_are_short() -> None:
    lengths = {path: len(path.read_text().splitlines()) for path in _sources(*PACKAGES, "tests")}
    long = {str(path.relative_to(ROOT)): n for path, n in lengths.items() if n > MAX_FILE_LINES}
    assert not long


def test_functions_are_short() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
        for path in _sources(*PACKAGES)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and _body_lines(node) > MAX_FUNCTION_LINES
    ]
    assert not long


def test_slow_tests_are_marked_where_make_seeks_them() -> None:
    """`make test-slow` looks only through test files that hold the mark's own words."""
    words = "mark" + ".slow"
    assert words.replace(".", r"\.") in (ROOT / "Makefile").read_text()
    marked = [path for path in _sources("tests") if words in path.read_text()]
    assert len(marked) > 50
    assert [path.name for path in marked if not path.name.startswith("test_")] == []


def test_every_module_says_what_it_is() -> None:
    silent = [
        str(path.relative_to(ROOT))
        for path in _sources(*PACKAGES, "tests")
        if path.name != "__init__.py" and not ast.get_docstring(ast.parse(path.read_text()))
    ]
    assert not silent


def test_layers_hold() -> None:
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout


def test_packages_are_ours() -> None:
    """`model`, `train`, `storage` are common names: another package must not stand in for them."""
    for name in PACKAGES:
        module = __import__(name)
        assert module.__file__ is not None
        assert Path(module.__file__).is_relative_to(ROOT), module.__file__


def test_the_top_level_holds_what_the_design_names() -> None:
    tracked = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout
    allowed = {
        *PACKAGES, "tests", "docs", "examples", "requirements", "README.md", "LICENSE",
        "CONTRIBUTING.md", "DECISIONS.md", "MANIFEST.in", "Makefile", "pyproject.toml",
        "prefect.yaml", "mkdocs.yml",
    }  # fmt: skip
    top = {line.split("/")[0] for line in tracked.splitlines()}
    assert {name for name in top if not name.startswith(".")} <= allowed


def test_no_file_names_this_machine() -> None:
    pattern = re.compile(r"/(?:work|root|home)/\w+|py" r"pi\.org|pythonhos" r"ted|npm" r"js\.org")
    found = [
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in [
            *_sources(*PACKAGES, "tests", "examples"),
            *ROOT.glob("*.md"),
            *ROOT.glob("docs/**/*.md"),
        ]
        if (match := pattern.search(path.read_text()))
    ]
    assert not found
