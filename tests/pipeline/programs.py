"""Programs of tests, run in a process of their own."""

import os
import subprocess
import sys

from tests.conftest import ROOT


def printed_by(code: str, *words: str, **environment: str) -> str:
    """Return what another process prints that runs this code with these words."""
    ran = subprocess.run(
        [sys.executable, "-c", code, *words],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.strip()
