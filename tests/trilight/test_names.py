"""What `import trilight` offers: the same names to programs, to type checkers, and in documents.

The code of docs/reference/python.md and the notebooks of examples/ run as a user runs them.
A notebook's code cells are run in order in one fresh interpreter. A kernel (nbclient, ipykernel,
pyzmq) would add what no cell needs: the display of values.
"""

import ast
import json
import re
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType

import pytest

import trilight
from infra.setup.wheel_tree import PACKAGES
from tests.command_line import run_program
from tests.conftest import ROOT
from tests.for_each import for_each
from trilight import extend
from trilight.lazy import offered_names


@for_each(("module", "missing"), [(trilight, "rendr"), (extend, "TEMPLATE")])
def test_every_name_is_there(module: ModuleType, missing: str) -> None:
    for name in module.__all__:
        assert getattr(module, name) is not None, name
    assert trilight.__version__ == metadata.version("trilight")
    with pytest.raises(AttributeError, match=f"no attribute '{missing}'"):
        getattr(module, missing)


def test_no_name_is_one_that_a_wheel_needs() -> None:
    """There `trilight.train` is a package: importing it would replace a function of that name."""
    modules = {path.stem for path in (ROOT / "trilight").glob("*.py")}
    assert not {*trilight.__all__, *modules} & {*PACKAGES, "tests"}


@for_each("example", sorted((ROOT / "examples").glob("*.py")))
def test_examples_import_from_the_face_alone(example: Path) -> None:
    ours = {
        node.module
        for node in ast.walk(ast.parse(example.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES
    }
    assert not ours


@for_each("page", ["docs/reference/python.md", "README.md"])
def test_documents_name_what_is_there(page: str) -> None:
    text = (ROOT / page).read_text()
    named = set(re.findall(r"\btrilight\.([A-Za-z_]+)", "\n".join(_code(text))))
    assert named <= {*trilight.__all__, "extend"}


def _code(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def _require_runs(folder: Path, *words: str) -> None:
    """Run a program as a user does, in a separate folder."""
    run_program([sys.executable, *words], folder, PYTHONPATH=str(ROOT), MPLBACKEND="Agg")


NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))

FEW_SAMPLES = (
    "noise_floor_db=20",
    'noise_floor_db=20, changes={"renders.min_spp": 16, "renders.max_spp": 16}',
)
"""What an order's pictures have in the documents, and here."""
RUN_CELLS = f"""
import json, sys
cells = [cell for cell in json.load(open(sys.argv[1]))["cells"] if cell["cell_type"] == "code"]
for number, cell in enumerate(cells):
    text = "".join(cell["source"]).replace(*{FEW_SAMPLES})
    exec(compile(text, f"code cell {{number}}", "exec"), globals())
"""


@for_each("notebook", NOTEBOOKS)
def test_it_holds_code_and_no_outputs(notebook: Path) -> None:
    assert len(NOTEBOOKS) >= 2
    cells = [
        cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"
    ]
    assert len(cells) >= 5
    for cell in cells:
        assert (cell["outputs"], cell["execution_count"]) == ([], None)
        code = "".join(cell["source"])
        compile(code, notebook.name, "exec")
        assert set(re.findall(r"\btrilight\.(\w+)", code)) <= set(trilight.__all__)


@pytest.mark.slow("commands")
@for_each("notebook", NOTEBOOKS)
def test_it_runs(notebook: Path, tmp_path: Path) -> None:
    _require_runs(tmp_path, "-c", RUN_CELLS, str(notebook))


CODE = _code((ROOT / "docs/reference/python.md").read_text())


def test_the_page_is_a_program() -> None:
    assert len(CODE) == 6
    assert all(len(block.strip().splitlines()) <= 12 for block in CODE)
    compile("\n".join(CODE), "python.md", "exec")


@pytest.mark.slow("commands")
def test_the_page_runs(tmp_path: Path) -> None:
    """As one program without `if __name__ == "__main__"`, in a folder of its own."""
    program = tmp_path / "program.py"
    program.write_text("\n".join(CODE).replace(*FEW_SAMPLES))
    _require_runs(tmp_path, str(program))
    made = {path.name for path in tmp_path.iterdir()}
    assert {"still.usdz", "still.exr", "network.png", "set", "run", "evaluation"} <= made


@pytest.mark.slow("commands")
def test_the_lines_of_the_readme_run(tmp_path: Path) -> None:
    (code,) = _code((ROOT / "README.md").read_text())
    assert len(code.strip().splitlines()) <= 10
    (tmp_path / "program.py").write_text(code)
    _require_runs(tmp_path, str(tmp_path / "program.py"))
    assert (tmp_path / "knot.png").stat().st_size > 500


def test_a_name_is_exported_as_its_import_calls_it(tmp_path: Path) -> None:
    module = tmp_path / "package.py"
    module.write_text(
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n"
        "    from json import dumps as dumps\n"
        "    from os.path import join as joined, split as split\n"
    )
    assert offered_names(str(module)) == {
        "dumps": ("json", "dumps"),
        "joined": ("os.path", "join"),
        "split": ("os.path", "split"),
    }
