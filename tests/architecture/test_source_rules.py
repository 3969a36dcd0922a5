"""The house rules that a machine can hold: size of files and functions, layers, stray words.

The test of a file is where its name says: tests/a/b/test_c.py tests a/b/c.py.
"""

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from infra.setup import build_backend
from tests.command_line import run_program
from tests.conftest import ROOT

PACKAGES = ("trilight", *build_backend.PACKAGES)
MAX_FILE_LINES = 600
MAX_FUNCTION_LINES = 60
DOCSTRING = re.compile(r'(?:#[^\n]*\n|\s)*[rR]?"""\s*\S')
"""How a module begins that says what it is."""
IMPORTS = re.compile(rf"\b(?:from|import) (?:{'|'.join(build_backend.PACKAGES)})\b(?:\.| import)")
MODULE = re.compile(rf"(?:{'|'.join(build_backend.PACKAGES)})(?:\.[a-z_0-9]+)+")


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What the rules look at in a module."""

    long_functions: list[str]
    public_classes: list[str]
    imported: set[str]
    """Top-level packages, wherever in the file they are imported."""
    import_texts: list[str]
    """Strings that import a package of ours."""
    module_names: list[str]
    """Strings that are the dotted name of a module of ours."""
    asks_for_names: bool
    """Whether it asks storage.installation for names of modules."""


def _sources(*folders: str) -> Iterator[Path]:
    for folder in folders:
        yield from sorted((ROOT / folder).rglob("*.py"))


def _body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines after signature and docstring: prose is free, work is not."""
    body = function.body
    if ast.get_docstring(function) is not None:
        body = body[1:]
    return (function.end_lineno or 0) - body[0].lineno + 1 if body else 0


def _facts(source: str) -> Facts:
    tree = ast.parse(source)
    long, imported, strings, prose = list[str](), set[str](), dict[int, str](), set[int]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant):
            if isinstance(node.value, str):
                strings[id(node)] = node.value
        elif isinstance(node, ast.Expr):
            prose.add(id(node.value))
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if _body_lines(node) > MAX_FUNCTION_LINES:
                long.append(f"{node.lineno} {node.name}")
        elif isinstance(node, ast.Import):
            imported.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or "").partition(".")[0])
    texts = [text for name, text in strings.items() if name not in prose]
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    return Facts(
        long_functions=long,
        public_classes=[name for name in classes if not name.startswith("_")],
        imported=imported,
        import_texts=[text for text in texts if IMPORTS.search(text)],
        module_names=[text for text in texts if _is_module(text)],
        asks_for_names="module_name(" in source,
    )


def _is_module(text: str) -> bool:
    """Return whether a string is a dotted name that could be imported, such as `a.b`."""
    if not MODULE.fullmatch(text):
        return False
    place = ROOT / text.replace(".", "/")
    return place.is_dir() or place.with_suffix(".py").is_file()


@pytest.fixture(scope="module")
def facts() -> dict[str, Facts]:
    """Every module of the product, parsed once, by its path."""
    found = {
        path.relative_to(ROOT).as_posix(): _facts(path.read_text()) for path in _sources(*PACKAGES)
    }
    assert len(found) > 300, "the walk finds the modules"
    return found


def test_files_are_short() -> None:
    lengths = {path: len(path.read_text().splitlines()) for path in _sources(*PACKAGES, "tests")}
    long = {str(path.relative_to(ROOT)): n for path, n in lengths.items() if n > MAX_FILE_LINES}
    assert not long


def test_functions_are_short(facts: dict[str, Facts]) -> None:
    assert [f"{path}:{text}" for path, each in facts.items() for text in each.long_functions] == []


def test_no_two_public_classes_have_one_name(facts: dict[str, Facts]) -> None:
    """A search for a class finds one; of the bench, files may have classes of the same name."""
    found = defaultdict[str, list[str]](list)
    for path, each in facts.items():
        if not path.startswith(("infra/bench/", "trilight/")):
            for name in each.public_classes:
                found[name].append(path)
    assert len(found) > 200, "the walk finds the classes"
    assert {name: paths for name, paths in found.items() if len(paths) > 1} == {}


def test_no_string_names_a_module_of_ours(facts: dict[str, Facts]) -> None:
    """A wheel rewrites no strings: code that needs such a name asks storage.installation."""
    for path, each in facts.items():
        if not path.startswith("trilight/"):
            assert each.import_texts == [], path
            assert each.asks_for_names or each.module_names == [], path


def test_each_library_that_makes_the_project_has_a_job_in_it(facts: dict[str, Facts]) -> None:
    """A manifest states their versions: one that nothing calls would be stated in vain."""
    imported = {name for each in facts.values() for name in each.imported}
    libraries = "mitsuba trimesh pymeshlab roma torch webdataset prefect OpenEXR pxr"
    assert set(libraries.split()) - imported == set()


def test_only_what_runs_in_blender_imports_it(facts: dict[str, Facts]) -> None:
    scripts = {
        "infra/bench/workloads/blender_process.py",
        "infra/blender/exact_materials.py",
    }
    assert {path for path, each in facts.items() if "bpy" in each.imported} == scripts
    assert not any(facts[script].imported & set(PACKAGES) for script in scripts)


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
        if path.name != "__init__.py" and not DOCSTRING.match(path.read_text())
    ]
    assert not silent


def test_layers_hold() -> None:
    run_program([Path(sys.executable).parent / "lint-imports", "--no-cache"])


def test_packages_are_ours() -> None:
    """`model`, `train`, `storage` are common names: another package must not stand in for them."""
    for name in PACKAGES:
        module = __import__(name)
        assert module.__file__ is not None
        assert Path(module.__file__).is_relative_to(ROOT), module.__file__


def test_the_top_level_holds_what_the_design_names() -> None:
    tracked = run_program(["git", "ls-files"]).stdout
    allowed = {
        *PACKAGES, "tests", "docs", "examples", "requirements", "README.md", "LICENSE",
        "CONTRIBUTING.md", "DECISIONS.md", "MANIFEST.in", "Makefile", "pyproject.toml",
        "prefect.yaml", "mkdocs.yml", "AGENTS.md", "CHANGELOG.md",
        "CITATION.cff",
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


def test_next_steps_are_printed_in_one_place() -> None:
    """So that one test can run them all; `make serve` prints the documents' own lines."""
    found = {
        path.relative_to(ROOT).as_posix()
        for path in _sources("infra", "pipeline", "storage", "train", "model")
        if re.search(r"Next(?: step)?:", path.read_text())
    }
    assert found == {"infra/cli/console.py", "infra/serving/local.py"}


TESTS = ROOT / "tests"
BESIDE = {"architecture", "end_to_end", "extremes", "hostile", "laws", "references"}
"""Folders of tests that are about no single file."""


def _tests() -> list[Path]:
    found = (path.relative_to(TESTS) for path in TESTS.rglob("test_*.py"))
    return sorted(path for path in found if path.parts[0] not in BESIDE)


def test_every_folder_of_tests_is_a_folder_of_the_product() -> None:
    folders = {path.parent for path in _tests()}
    assert len(folders) > 20, "the walk finds the tests"
    assert [str(folder) for folder in folders if not (ROOT / folder).is_dir()] == []


def test_a_test_that_is_named_for_a_file_is_at_its_place() -> None:
    """A name that several files of a package have says which by its place."""
    places = defaultdict[tuple[str, str], set[Path]](set)
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            places[package, path.stem].add(path.relative_to(ROOT).parent)
    misplaced = {}
    for test in _tests():
        wanted = places[test.parts[0], test.stem.removeprefix("test_")]
        if wanted and test.parent not in wanted:
            misplaced[str(test)] = sorted(map(str, wanted))
    assert misplaced == {}
