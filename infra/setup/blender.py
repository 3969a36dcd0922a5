"""Installs Blender before the slow tests that compare with it; they skip where it cannot be had."""

import sys

from infra.bench.workloads.blender_environment import blender_python
from storage.errors import TrilightError

if __name__ == "__main__":
    try:
        blender_python()
    except TrilightError as error:
        sys.stderr.write(f"{error} Tests beside it will skip.\n")
