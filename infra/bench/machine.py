"""Record of the measuring machine: processor, cores, system, libraries, commit."""

import os
import platform
import shutil
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from infra.processor import processor

ROOT = Path(__file__).parents[2]

_LIBRARIES = ("trilight", "mitsuba", "drjit", "pyoidn", "numpy", "torch", "pymeshlab",
              "wasmtime", "libigl", "OpenEXR", "h5py")  # fmt: skip


def machine_record(device: str) -> dict[str, Any]:
    """Return the record of this machine as JSON values; on the device `cuda` with its GPU."""
    versions = {}
    for library in _LIBRARIES:
        try:
            versions[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return {
        **({"gpu": _gpu_name()} if device == "cuda" else {}),
        "processor": processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": versions,
        "commit": commit_text(),
    }


def _gpu_name() -> str:
    import torch

    return str(torch.cuda.get_device_name()) if torch.cuda.is_available() else "no GPU"


def commit_text(root: Path = ROOT) -> str:
    """Return the commit of a checkout, with -dirty if files other than documents differ.

    Results are documents, so that a run that writes them resumes as the same commit.
    """
    if shutil.which("git") is None:
        return "unknown"  # an image has none

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["git", *words], cwd=root, capture_output=True, text=True, check=False
        )

    commit = git("describe", "--always").stdout.strip()
    changed = git("diff", "--quiet", "HEAD", "--", ".", ":(exclude)docs").returncode == 1
    return f"{commit}-dirty" if changed else commit or "unknown"
