"""The notebooks of examples/: without outputs, and programs that run.

A notebook is JSON, and its code cells are run in order in one fresh interpreter here. A kernel
(nbclient, ipykernel, pyzmq) would add what no cell needs: the display of values.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import trilight
from tests.conftest import ROOT
from tests.for_each import for_each

NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))

RUN = """
import json, sys
cells = [cell for cell in json.load(open(sys.argv[1]))["cells"] if cell["cell_type"] == "code"]
for number, cell in enumerate(cells):
    exec(compile("".join(cell["source"]), f"code cell {number}", "exec"), globals())
"""


def _cells(notebook: Path) -> list[dict[str, Any]]:
    cells: list[dict[str, Any]] = json.loads(notebook.read_text())["cells"]
    return cells


@for_each("notebook", NOTEBOOKS)
def test_it_holds_code_and_no_outputs(notebook: Path) -> None:
    cells = [cell for cell in _cells(notebook) if cell["cell_type"] == "code"]
    assert len(cells) >= 5
    for cell in cells:
        assert (cell["outputs"], cell["execution_count"]) == ([], None)
        code = "".join(cell["source"])
        compile(code, notebook.name, "exec")
        assert set(re.findall(r"\btrilight\.(\w+)", code)) <= set(trilight.__all__)


@pytest.mark.slow("commands")
@for_each("notebook", NOTEBOOKS)
def test_it_runs(notebook: Path, tmp_path: Path) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", RUN, str(notebook)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr


def test_there_are_two() -> None:
    assert len(NOTEBOOKS) >= 2
