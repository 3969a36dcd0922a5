"""What a wheel is built from: our packages below `trilight`, and nothing of a user's replaced."""

import ast
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from infra.setup.wheel_tree import FACE, PACKAGES, with_prefix, write_wheel_tree
from tests.conftest import ROOT


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tree")
    write_wheel_tree(ROOT, folder)
    return folder


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("from storage.errors import Rejected", "from trilight.storage.errors import Rejected"),
        ("from storage import scene", "from trilight.storage import scene"),
        ("if x:\n    from train import run", "if x:\n    from trilight.train import run"),
        ("import model.config as c, os", "import trilight.model.config as c, os"),
        ("é = 1; from infra import cli", "é = 1; from trilight.infra import cli"),
        ("from pipeline.a import (\n    b,\n)", "from trilight.pipeline.a import (\n    b,\n)"),
        ("from trilight.extend import Scene", "from trilight.extend import Scene"),
        ("from model_zoo import storage", "from model_zoo import storage"),
        ("import numpy, storages", "import numpy, storages"),
        ("text = 'from storage import scene'", "text = 'from storage import scene'"),
        ("train = 1  # from model import x", "train = 1  # from model import x"),
    ],
)  # fmt: skip
def test_imports_get_the_prefix_and_nothing_else_does(source: str, expected: str) -> None:
    assert with_prefix(source) == expected


@pytest.mark.parametrize("source", ["import storage", "import os, model.config"])
def test_an_import_that_binds_a_package_of_ours_is_refused(source: str) -> None:
    with pytest.raises(SyntaxError, match="cannot get a prefix; use from"):
        with_prefix(source)


def _sources(tree: Path) -> Iterator[tuple[str, str]]:
    for path in sorted((tree / FACE).rglob("*.py")):
        yield str(path.relative_to(tree)), path.read_text()


def test_no_module_of_the_tree_imports_a_package_at_the_top(tree: Path) -> None:
    checked = 0
    for name, source in _sources(tree):
        compile(source, name, "exec")
        for node in ast.walk(ast.parse(source)):
            found = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            found += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {text.split(".")[0] for text in found} & {*PACKAGES, "tests"}, name
            checked += len(found)
    assert checked > 2000


def test_lines_keep_their_numbers(tree: Path) -> None:
    for package in (*PACKAGES, FACE):
        for path in (ROOT / package).rglob("*.py"):
            beside = tree / ("" if package == FACE else FACE) / path.relative_to(ROOT)
            assert beside.read_text().count("\n") == path.read_text().count("\n"), path


def test_no_string_names_a_module_of_ours() -> None:
    """Strings are not rewritten: who needs a name in one asks storage.installation for it."""
    imports = re.compile(rf"\b(?:from|import) (?:{'|'.join(PACKAGES)})\b(?:\.| import)")
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            source = path.read_text()
            asks = "module_name(" in source
            for text, line in _strings_but_prose(ast.parse(source)):
                assert not imports.search(text), (path, line)
                assert asks or not _is_module(text), (path, line)


def _strings_but_prose(module: ast.Module) -> Iterator[tuple[str, int]]:
    prose = {id(node.value) for node in ast.walk(module) if isinstance(node, ast.Expr)}
    for node in ast.walk(module):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose:
            yield node.value, node.lineno


def _is_module(text: str) -> bool:
    """Return whether a string is a dotted name that could be imported, such as `a.b`."""
    if not re.fullmatch(rf"(?:{'|'.join(PACKAGES)})(?:\.[a-z_0-9]+)+", text):
        return False
    place = ROOT / text.replace(".", "/")
    return place.is_dir() or place.with_suffix(".py").is_file()


def test_all_files_of_the_checkout_are_in_the_tree(tree: Path) -> None:
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PACKAGES, FACE]
    tracked = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True)
    for name in tracked.stdout.splitlines():
        assert (tree / ("" if name.startswith(f"{FACE}/") else FACE) / name).is_file(), name
    assert (tree / FACE / "prefect.yaml").is_file()


PROGRAM = """
import sys

import model
import storage.errors
import train
import trilight
from trilight import Material, SceneBuilder

# how other modules of ours are started, and children: by names that are found here
from trilight.storage.installation import FILES_ROOT, IMPORT_ROOT, module_name

scene = SceneBuilder().add_floor().add_lamp(at=(0, 0, 2)).add_camera(at=(0, -2, 1)).scene()
trilight.write_scene(scene, "it.safetensors")
scene = trilight.read_scene("it.safetensors")
assert trilight.first_hits(scene, resolution=8).met.any()
assert trilight.named_run("smoke").run == "smoke"
assert [module.WHOSE for module in (model, train, storage.errors)] == ["the user's"] * 3
ours = {"scene_templates", "pipeline", "infra"} & set(sys.modules)
assert not ours, ours
assert module_name("pipeline.flows") == "trilight.pipeline.flows"
assert (IMPORT_ROOT / "trilight") == FILES_ROOT
assert (FILES_ROOT / "prefect.yaml").is_file()
"""


def test_a_program_keeps_its_own_model_train_and_storage(tree: Path, tmp_path: Path) -> None:
    for place in ("model.py", "train/__init__.py", "storage/__init__.py", "storage/errors.py"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text('WHOSE = "the user\'s"\n')
    (tmp_path / "program.py").write_text(textwrap.dedent(PROGRAM))
    for command in (["program.py"], ["-m", "trilight", "--version"]):
        ran = subprocess.run(
            [sys.executable, *command],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(tree)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr
