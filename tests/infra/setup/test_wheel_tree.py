"""What a wheel is built from: our packages below `trilight`, and nothing of a user's replaced."""

import ast
import re
import sys
import textwrap
import zipfile
from pathlib import Path

import pytest

from infra.setup.build_backend import (
    CHECKOUT_ONLY,
    FACE,
    PACKAGES,
    build_editable,
    with_prefix,
    write_wheel_tree,
)
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.for_each import case


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tree")
    write_wheel_tree(ROOT, folder)
    return folder


def test_imports_get_the_prefix_or_are_refused_and_nothing_else_does() -> None:
    for source, expected in [
        ("from storage.errors import Rejected", "from trilight.storage.errors import Rejected"),
        ("if x:\n    from train import run", "if x:\n    from trilight.train import run"),
        ("import model.config as c, os", "import trilight.model.config as c, os"),
        ("é = 1; from infra import cli", "é = 1; from trilight.infra import cli"),
        ("from pipeline.a import (\n    b,\n)", "from trilight.pipeline.a import (\n    b,\n)"),
        ("from trilight.extend import Scene", "from trilight.extend import Scene"),
        ("from model_zoo import storage", "from model_zoo import storage"),
        ("text = 'from storage import scene'", "text = 'from storage import scene'"),
    ]:  # fmt: skip
        with case(source):
            assert with_prefix(source) == expected
    for source in ["import storage", "import os, model.config"]:
        with case(source), pytest.raises(SyntaxError, match="cannot get a prefix; use from"):
            with_prefix(source)


AT_THE_TOP = re.compile(rf"^\s*(?:from|import) (?:{'|'.join((*PACKAGES, 'tests'))})\b", re.M)
IMPORTED = re.compile(rf"^\s*(?:from|import) {FACE}\b", re.M)


def test_no_module_of_the_tree_imports_a_package_at_the_top(tree: Path) -> None:
    """Lines are looked at, and a file is parsed only where one looks like such an import."""
    checked = 0
    for path in sorted((tree / FACE).rglob("*.py")):
        source = path.read_text()
        checked += len(IMPORTED.findall(source))
        if AT_THE_TOP.search(source):
            assert not _imported(ast.parse(source)) & {*PACKAGES, "tests"}, path
    assert checked > 2000


def _imported(module: ast.Module) -> set[str]:
    names = []
    for node in ast.walk(module):
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
    return {name.partition(".")[0] for name in names}


def test_all_files_of_the_checkout_are_in_the_tree_with_their_lines(tree: Path) -> None:
    for package in (*PACKAGES, FACE):
        for path in (ROOT / package).rglob("*.py"):
            if any(path.is_relative_to(ROOT / name) for name in CHECKOUT_ONLY):
                continue
            beside = tree / ("" if package == FACE else FACE) / path.relative_to(ROOT)
            assert beside.read_text().count("\n") == path.read_text().count("\n"), path
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PACKAGES, FACE]
    for name in run_program(listed).stdout.splitlines():
        copied = tree / ("" if name.startswith(f"{FACE}/") else FACE) / name
        left_out = any(Path(name).is_relative_to(each) for each in CHECKOUT_ONLY)
        assert copied.is_file() != left_out, name
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
assert trilight.training_preset("smoke").run == "smoke"
assert [module.WHOSE for module in (model, train, storage.errors)] == ["the user's"] * 3
ours = {"scene_templates", "pipeline", "infra"} & set(sys.modules)
assert not ours, ours
assert module_name("pipeline.flows") == "trilight.pipeline.flows"
assert (IMPORT_ROOT / "trilight") == FILES_ROOT
assert (FILES_ROOT / "prefect.yaml").is_file()
assert trilight.judge_network.__module__ == "trilight.infra.judging"
"""


def test_a_program_keeps_its_own_model_train_and_storage(tree: Path, tmp_path: Path) -> None:
    for place in ("model.py", "train/__init__.py", "storage/__init__.py", "storage/errors.py"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text('WHOSE = "the user\'s"\n')
    (tmp_path / "program.py").write_text(textwrap.dedent(PROGRAM))
    for command in (["program.py"], ["-m", "trilight", "--version"]):
        run_program([sys.executable, *command], tmp_path, PYTHONPATH=str(tree))


@pytest.mark.filterwarnings("ignore::Warning")
def test_beside_a_clone_our_package_is_found_and_not_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder without `__init__.py` hides what an import hook finds, and not what is on a path."""
    clone, site = tmp_path / "trilight", tmp_path / "site"
    (clone / "trilight").mkdir(parents=True)
    (clone / "trilight" / "__init__.py").write_text("NAME = 'ours'\n")
    project = (
        "[project]\nname = 'trilight'\nversion = '1'\n[tool.setuptools]\npackages = ['trilight']"
    )
    (clone / "pyproject.toml").write_text(project)
    site.mkdir()
    monkeypatch.chdir(clone)
    monkeypatch.setattr("sys.argv", ["setup.py"])
    with zipfile.ZipFile(site / build_editable(str(site))) as wheel:
        wheel.extractall(site)
    script = tmp_path / "mine.py"
    script.write_text(
        f"import site; site.addsitedir({str(site)!r}); import trilight; trilight.NAME"
    )
    run_program([sys.executable, "-S", "-E", str(script)], tmp_path)
