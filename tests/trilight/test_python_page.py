"""The code of docs/reference/python.md, as somebody would paste it into a file of theirs."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

PAGE = (ROOT / "docs/reference/python.md").read_text()
CODE = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_page_is_a_program() -> None:
    assert len(CODE) == 4
    compile("\n".join(CODE), "python.md", "exec")


@pytest.mark.slow("commands")
def test_the_page_runs(tmp_path: Path) -> None:
    """As one program without `if __name__ == "__main__"`, in a folder of its own."""
    program = tmp_path / "program.py"
    program.write_text("\n".join(CODE))
    ran = subprocess.run(
        [sys.executable, str(program)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    made = {path.name for path in tmp_path.iterdir()}
    assert {"still.usdz", "still.exr", "network.png", "set", "run", "evaluation"} <= made
